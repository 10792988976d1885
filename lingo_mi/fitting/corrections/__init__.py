"""What is fitted besides the cloud: kinds of `correction.Correction`, a file each."""
