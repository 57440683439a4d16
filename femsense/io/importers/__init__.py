"""Importers of recordings of other programs, one module per format. `guess` identifies the format, `writer` writes the recording."""
