"""The command `rts` as `python -m rts`."""

from importlib.metadata import distribution

from rts.registry import OWN

if __name__ == "__main__":
    distribution(OWN).entry_points.select(group="console_scripts")["rts"].load()()
