"""The body: meshes, elements, cables, static equilibrium and compliance. Arrays and small frozen objects in and out."""
