"""`python -m dualbrain` is the command `dualbrain`: launchers of several processes start modules."""

from dualbrain.cli.main import main

if __name__ == "__main__":
    main()
