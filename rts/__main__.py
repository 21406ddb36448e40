"""`python -m rts`: the command `rts`."""

from rts.cli.main import main

if __name__ == "__main__":
    main()
