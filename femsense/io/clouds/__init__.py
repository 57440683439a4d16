"""Clouds and depth images in files."""
