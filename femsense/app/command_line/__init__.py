"""The commands as Typer sees them: their parameters, and what each says. `femsense.app.cli` lists and runs them.

The parameter `json` of each is declared for the help; `run` acts on it.
"""
