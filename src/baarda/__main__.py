"""``python -m baarda`` is the command line."""

if __name__ == "__main__":
    from baarda.cli import main

    main()
