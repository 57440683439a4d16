"""The commands: functions of their parameters that return an answer. `femsense.app.cli` lists and runs them.

Each has `--json`, declared for the help; `run` acts on it.
"""
