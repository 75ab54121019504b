"""The VIMA policy."""
