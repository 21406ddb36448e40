"""The command `rts`, where it starts."""

import sys


def main() -> None:
    """The entry point `rts`; one line on standard error if the packages of the extra `cli` are missing."""
    try:
        from rts_cli.main import main
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("rich", "typer"):
            raise
        sys.exit(f"error: the command rts needs the package {error.name!r}: pip install 'rasterize-then-splat[cli]'")
    main()


if __name__ == "__main__":
    main()
