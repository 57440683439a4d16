"""`python -m femsense` is the command `femsense`."""

from __future__ import annotations

from femsense.app.cli import main

if __name__ == "__main__":
    main()
