"""The command line."""

from intercap_core.cli.main import app, main

__all__ = ["app", "main"]
