"""Depth images and clouds in folders and files: lenses, registration of colours, pictures."""
