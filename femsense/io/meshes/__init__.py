"""Mesh files of other programs: points, cells and cell data."""
