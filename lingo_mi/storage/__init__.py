"""Files and folders that a kill, a full disk or a second process cannot spoil."""
