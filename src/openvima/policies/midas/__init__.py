"""MIDAS."""
