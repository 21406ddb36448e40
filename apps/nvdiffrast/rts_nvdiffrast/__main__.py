"""`rts_nvdiffrast run script.py …`: a script for nvdiffrast, run on the CPU as it is.

With `--pretend-cuda`, `torch.cuda.is_available()` is true.
"""

import sys

from rts_nvdiffrast.redirect import run

USAGE = "usage: rts_nvdiffrast run [--pretend-cuda] script.py [arguments of the script]"
PRETEND = "--pretend-cuda"


def main(arguments: list[str] | None = None) -> None:
    """Run the script that the arguments name, or say how to; by default, the arguments of this program."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] in (["-h"], ["--help"]):
        print(f"{USAGE}\n\n{__doc__}")
        return
    pretend = arguments[1:2] == [PRETEND]
    script = arguments[2:] if pretend else arguments[1:]
    if arguments[:1] != ["run"] or not script:
        sys.exit(USAGE)
    run(script[0], script[1:], pretend)


if __name__ == "__main__":
    main()
