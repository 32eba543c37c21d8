"""``python -m baarda`` is the command line."""

from baarda.cli import main

main()
