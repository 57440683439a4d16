"""What other programs record, as frames: one file a format. `guess` finds the format, `writer` makes the recording."""
