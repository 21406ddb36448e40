"""The stub `rts/__init__.pyi` beside the code that it declares.

The core imports no plugin package, for types neither, so the stub repeats signatures and docstrings of the built-in
surfaces and functions. A test compares them; run this file to write the stub anew where it falls behind.
"""

import ast
import inspect
import subprocess
import sys
import textwrap
from dataclasses import is_dataclass
from pathlib import Path

import rts

PATH = Path(rts.__file__).with_suffix(".pyi")
FUNCTIONS = (ast.FunctionDef, ast.ClassDef)


def code_of(name):
    """The object that the stub declares under a name; None for a base class that is the stub's alone.

    `_Tuned` of the stub is `Tuned` of the code: no attribute of `rts`, and found beside those that are.
    """
    if not name.startswith("_"):
        return getattr(rts, name)
    places = [vars(sys.modules[getattr(rts, n).__module__]) for n in rts.registry.built_in_attributes()]
    return next((place[name[1:]] for place in places if name[1:] in place), None)


def documented(node, text, depth):
    """Give a node of the stub a docstring, indented by some levels; None for none."""
    first = node.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
        node.body.pop(0)
    if text is not None:
        text = textwrap.indent(inspect.cleandoc(text), "    " * depth).strip()
        text += "\n" + "    " * depth if "\n" in text else ""
        node.body.insert(0, ast.Expr(ast.Constant(text)))
    return node


def function(node, code, depth):
    """A function of the stub with the parameters, defaults, result and docstring of the code."""
    source = ast.parse(textwrap.dedent(inspect.getsource(code))).body[0]
    node.args, node.returns = source.args, source.returns or ast.Constant(None)
    values = [
        p.default for p in inspect.signature(code).parameters.values() if p.default is not inspect.Parameter.empty
    ]
    shown = [ast.parse(repr(value), mode="eval").body for value in values]
    node.args.defaults, rest = shown[: len(node.args.defaults)], shown[len(node.args.defaults) :]
    node.args.kw_defaults = [None if default is None else rest.pop(0) for default in node.args.kw_defaults]
    node.body = [ast.Expr(ast.Constant(...))]
    return documented(node, code.__doc__, depth)


def class_(node, code):
    """A class of the stub with the docstring, the fields and the methods of the code."""
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and not any(ast.unparse(d) == "property" for d in item.decorator_list):
            function(item, inspect.unwrap(getattr(code, item.name)), 2)
        elif isinstance(item, ast.AnnAssign) and item.target.id in code.__annotations__:
            annotation = code.__annotations__[item.target.id]  # Named tuples wrap theirs.
            item.annotation = ast.parse(getattr(annotation, "__forward_arg__", annotation), mode="eval").body
            if is_dataclass(code) and item.target.id in vars(code):
                item.value = ast.Constant(vars(code)[item.target.id])
    return node if node.name.startswith("_") else documented(node, code.__doc__, 1)


def synced(text):
    """The syntax tree of the stub, with signatures and docstrings of the code."""
    tree = documented(ast.parse(text), rts.__doc__, 0)
    for node in tree.body:
        code = code_of(node.name) if isinstance(node, FUNCTIONS) else None
        if code is not None:
            class_(node, code) if isinstance(node, ast.ClassDef) else function(node, code, 1)
        elif isinstance(node, ast.Assign) and node.targets[0].id == "__all__":
            node.value = ast.parse(repr(rts.__all__), mode="eval").body
    own = {n.name for n in tree.body if isinstance(n, FUNCTIONS)}
    own |= {n.targets[0].id for n in tree.body if isinstance(n, ast.Assign)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and f"_{node.id}" in own:
            node.id = f"_{node.id}"
    return ast.fix_missing_locations(tree)


def main():
    text = PATH.read_text()
    comment = text[: text.index('"""')]
    PATH.write_text(comment + ast.unparse(synced(text)) + "\n")
    ruff = Path(sys.executable).with_name("ruff")
    for command in (["check", "--select", "I", "--fix"], ["format"]):
        subprocess.run([ruff, *command, "--quiet", PATH], check=True)


if __name__ == "__main__":
    main()
