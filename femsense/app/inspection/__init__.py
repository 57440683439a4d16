"""What is in a file, by its kind. `femsense.app.inspect` says which kind it is."""
