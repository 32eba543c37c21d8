"""The command line: short verbs over the public API, one file each. Nothing heavy is imported before a verb runs."""

from importlib import import_module

from baarda.cli.base import app

for _verb in ("demo", "adjust", "residuals", "compare", "simulate", "reproduce", "convert", "lists"):  # the order of the help
    import_module(f"baarda.cli.{_verb}")


def main() -> None:
    """Run the command line."""
    app()
