"""Entry point of `python -m dualbrain`, the same command line as `dualbrain`, for launchers that start modules."""

from dualbrain.cli.main import main

if __name__ == "__main__":
    main()
