"""LINGO's initial cloud, to be read beside section III of the paper, and its measure IPSD."""
