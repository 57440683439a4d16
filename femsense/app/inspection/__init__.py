"""Reports on files and folders, by their kind. `femsense.app.inspect` determines the kind."""
