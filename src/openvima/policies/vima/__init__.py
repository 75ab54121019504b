"""VIMA."""
