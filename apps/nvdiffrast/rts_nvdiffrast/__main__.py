"""`python -m rts_nvdiffrast run script.py …`: a script for nvdiffrast, run on the CPU as it is."""

import sys

from rts_nvdiffrast.redirect import run

USAGE = "usage: python -m rts_nvdiffrast run script.py [arguments of the script]"


def main(arguments: list[str]) -> None:
    """Run the script that the arguments name, or say how to."""
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"{USAGE}\n\n{__doc__}")
    elif len(arguments) < 2 or arguments[0] != "run":
        sys.exit(USAGE)
    else:
        run(arguments[1], arguments[2:])


if __name__ == "__main__":
    main(sys.argv[1:])
