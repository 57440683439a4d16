"""Skinned meshes, animation files and the page that shows them."""
