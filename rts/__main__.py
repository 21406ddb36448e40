"""The command `rts` as `python -m rts`."""

from rts.registry import load_own

if __name__ == "__main__":
    load_own("console_scripts", "rts")()
