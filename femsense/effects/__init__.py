"""Effects: what a plain model may lack, by name. One tuple of them; robot.toml and loop.json use the same names."""
