"""Mesh files of other programs, as points, cells and what the file says of each cell."""
