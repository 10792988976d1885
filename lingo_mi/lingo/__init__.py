"""LINGO's initial cloud, after section III of the paper, and its measure IPSD."""
