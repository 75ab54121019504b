"""Network parts that policies share. They need torch (`pip install openvima[train]`)."""
