"""The command `rts`, also as `python -m rts`."""

import sys


def main() -> None:
    """The entry point `rts`; one line on standard error if the packages of the extra `cli` are missing."""
    try:
        from rts.cli.main import main
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("rich", "typer"):
            raise
        sys.exit(f"error: the command rts needs the package {error.name!r}: pip install 'rasterize-then-splat[cli]'")
    main()


if __name__ == "__main__":
    main()
