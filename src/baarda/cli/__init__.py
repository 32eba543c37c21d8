"""The command line: short verbs over the public API, one file each. Nothing heavy is imported before a verb runs."""

from importlib import import_module

from baarda.cli.base import app

for _verb in (  # the order of the help
    "demo",
    "adjust",
    "batch",
    "split",
    "resect",
    "models",
    "residuals",
    "compare",
    "simulate",
    "reproduce",
    "convert",
    "lists",
):
    import_module(f"baarda.cli.{_verb}")


def main() -> None:
    """Run the command line."""
    app()
