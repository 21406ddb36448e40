"""The group of commands: installed ones among them, and expected errors and warnings in a line each."""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperGroup

from rts import plugin, plugins
from rts.errors import PluginError, RtsError
from rts.tool_api.plugins import distributions_of

# The base of BadParameter is click's UsageError, wherever typer keeps click.
UsageError: Any = typer.BadParameter.__base__


class CommandGroup(TyperGroup):
    """Commands, those of installed distributions too, whose expected errors are one line on standard error."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all commands, those of installed distributions last."""
        commands = super().list_commands(ctx)
        return [*commands, *(name for name in plugins("rts.commands") if name not in commands)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name, imported if it is an installed one; None for none."""
        found = super().get_command(ctx, cmd_name)
        if found is None and cmd_name in plugins("rts.commands"):
            return _installed_command(cmd_name)
        return found

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Show installed commands by name, and where they come from: their modules are not imported."""
        named = copy.copy(self)
        named.commands = {name: self.commands.get(name) or _named_command(name) for name in self.list_commands(ctx)}
        super(CommandGroup, named).format_help(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Let --debug stand anywhere before "--"; without arguments, show the help."""
        end = args.index("--") if "--" in args else len(args)
        if "--debug" in args[:end]:
            args = ["--debug", *(a for a in args[:end] if a != "--debug"), *args[end:]]
        with _one_line(ctx), _warnings_in_a_line():
            return super().parse_args(ctx, args or ["--help"])

    def invoke(self, ctx: Any) -> Any:
        """Run the command, with expected errors and warnings in a line each."""
        with _one_line(ctx), _warnings_in_a_line():
            return super().invoke(ctx)


def _installed_command(name: str) -> Any:
    """The command of an entry point, imported now; where that fails, a command that says why."""
    try:
        return _as_command(name, plugin("rts.commands", name))
    except PluginError as error:
        reason = error

    def broken() -> None:
        raise reason

    broken.__doc__ = f"cannot be used: {_line(str(reason))}"
    return _as_command(name, broken, {"ignore_unknown_options": True, "allow_extra_args": True})


def _named_command(name: str) -> Any:
    """A command that only stands for one of an installed distribution, in the help."""

    def unread() -> None:
        pass

    unread.__doc__ = f"Of {distributions_of('rts.commands', name)}: `rts {name} --help` tells more."
    return _as_command(name, unread)


def _as_command(name: str, found: Any, settings: dict[str, Any] | None = None) -> Any:
    """A function, or a `typer.Typer`, as a command of this name; a PluginError if it is neither.

    `settings` are those of the command's context; a `typer.Typer` has its own.
    """
    try:
        if not isinstance(found, typer.Typer):
            alone = typer.Typer(rich_markup_mode="markdown", add_completion=False)
            alone.command(name, context_settings=settings)(found)
            found = alone
        command = typer.main.get_command(found)
    except Exception as error:
        raise PluginError(
            f"the command {name!r} is neither a function of options nor a typer.Typer: {error}"
        ) from error
    command.name = name
    return command


@contextlib.contextmanager
def _one_line(ctx: Any) -> Iterator[None]:
    """Turn expected errors into a line on standard error and an exit code: 2 for wrong usage, else 1.

    With --debug, errors other than wrong usage are raised as they are.
    """
    try:
        yield
    except UsageError as error:
        command = error.ctx.info_name if error.ctx is not None and error.ctx.parent else ctx.invoked_subcommand
        help_ = " ".join(filter(None, ("rts", command, "--help")))
        _fail(error, f"{error.format_message().rstrip('.')}; try '{help_}'", 2)
    except BrokenPipeError:  # The reader of the output has closed it; click handles that.
        raise
    except (RtsError, OSError, MemoryError) as error:
        if ctx.params.get("debug"):
            raise
        _fail(error, str(error) or "there is not enough memory; choose a smaller size", 1)


@contextlib.contextmanager
def _warnings_in_a_line() -> Iterator[None]:
    """Show each warning once, as a line on standard error, without the line of code that it came from."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type, *_: Any) -> None:
        text = _line(str(message))
        if text not in shown:
            shown.add(text)
            typer.echo(f"rts: warning: {text}", err=True)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _line(text: str) -> str:
    """The text in one line. Control characters, which a quoted file may contain, are escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))


def _fail(error: Exception, message: str, code: int) -> None:
    typer.echo(f"rts: {_line(message)}", err=True)
    raise typer.Exit(code) from error
