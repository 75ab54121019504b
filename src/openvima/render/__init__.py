"""Cameras and the triangle rasteriser."""
