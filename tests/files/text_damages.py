"""Sheets as text with damaged numbers, words, lines and ends of lines."""

import re

import numpy as np
from sheets import BROKEN, GONE, MORE, TEXTS, Case, model

ARABIC, _WIDE, _LAO = (
    str.maketrans("0123456789", "".join(chr(first + i) for i in range(10))) for first in (0x660, 0xFF10, 0xED0)
)
NUMBERS = {
    "arabic digits": lambda x: x.translate(ARABIC),
    "wide digits": lambda x: x.translate(_WIDE),
    "lao digits": lambda x: x.translate(_LAO),
    "a no-break space after": lambda x: x + "\u00a0",
    "a narrow space before": lambda x: "\u202f" + x,
    "a no-break space inside": lambda x: x[0] + "\u00a0" + (x[1:] or "1"),
    "a thin space inside": lambda x: x[0] + "\u2009" + (x[1:] or "1"),
    "a file separator inside": lambda x: x[0] + "\x1c" + (x[1:] or "1"),
    "a next line inside": lambda x: x[0] + "\x85" + (x[1:] or "1"),
    "a line separator inside": lambda x: x[0] + "\u2028" + (x[1:] or "1"),
    "a form feed inside": lambda x: x[0] + "\f" + (x[1:] or "1"),
    "no width inside": lambda x: x[0] + "\u200b" + x[1:],
    "an underscore": lambda x: x + "_0",
    "a comma": lambda x: x.replace(".", ",") if "." in x else x + ",0",
    "an apostrophe": lambda x: x + "'000",
    "a plus": lambda x: "+" + x,
    "two signs": lambda x: "+-" + x,
    "a wide minus": lambda x: "\u2212" + x,
    "an exponent D": lambda x: x + "D0",
    "an exponent d": lambda x: x + "d+00",
    "an open exponent": lambda x: x + "e",
    "an open exponent with a sign": lambda x: x + "e+",
    "hexadecimal": lambda x: "0x" + x,
    "an f": lambda x: x + "f",
    "nothing but a point": lambda x: ".",
    "nothing but a sign": lambda x: "-",
    "nan": lambda x: "nan",
    "NaN(1)": lambda x: "NaN(1)",
    "-nan(ind)": lambda x: "-nan(ind)",
    "1.#QNAN": lambda x: "1.#QNAN",
    "inf": lambda x: "-inf",
    "infinity": lambda x: "Infinity",
    "1e39": lambda x: "1e39",
    "1e999": lambda x: "1e999",
    "a superscript": lambda x: x + "\u00b2",
    "a fraction": lambda x: "\u00bd",
    "a quote": lambda x: f'"{x}"',
    "a word": lambda x: "null",
    "a NUL": lambda x: x + "\0",
    "two points": lambda x: x + ".0.",
}
INDICES = {
    "minus one": lambda x: "-1",
    "minus zero": lambda x: "-0",
    "far behind": lambda x: "-99",
    "one too far": lambda x: "10",
    "2^31": lambda x: str(2**31),
    "2^32 more": lambda x: str(2**32 + 1),
    "2^64 more": lambda x: str(2**64 + 1),
    "5000 digits": lambda x: "1" * 5000,
    "a half": lambda x: "1.5",
    "an exponent": lambda x: "1e0",
    "four of a corner": lambda x: x + "/1/1/1",
    "a slash at the end": lambda x: x + "/",
    "four slashes": lambda x: x + "////",
    "a slash before": lambda x: "/" + x,
    "a backslash between": lambda x: x.partition("/")[0] + "\\1",
    "zero": lambda x: "0",
}
_COUNTS_BACK = "an index that counts back from the last row is sound"
OTHER_INDICES = {
    ("obj", "minus one"): _COUNTS_BACK,
    ("plain.obj", "minus one"): _COUNTS_BACK,
    ("ply", "zero"): BROKEN,
    ("off", "zero"): BROKEN,
    **{(kind, name): BROKEN for kind in ("ply", "off") for name in ("minus zero", "an exponent")},
}
_VERTEX = {"obj": "v ", "plain.obj": "v ", "ply": r"[\d.]+ [\d.]+ [\d.]+$", "off": r"[\d.]+ [\d.]+ [\d.]+$"} | {
    "stl": r"\s*vertex"
}
_FACE = {"obj": "f ", "plain.obj": "f ", "ply": r"3 \d+ \d+ \d+$", "off": r"3 \d+ \d+ \d+$", "stl": r"\s*facet"}


def _places(kind, pattern, which=(0, 3, -1)):
    """The lines of a text, and the numbers of the first, fourth and last that the pattern of its kind finds."""
    lines = TEXTS[kind].splitlines()
    places = [i for i, line in enumerate(lines) if re.match(pattern[kind], line)]
    if kind == "off" and pattern is _VERTEX:
        places = places[1:]  # The first are the counts.
    return lines, [places[i] for i in which]


def _with_line(kind, lines, place, *those):
    return model(kind, "\n".join([*lines[:place], *those, *lines[place + 1 :]]) + "\n")


def number_cases():
    """One number of a text written in another way, or another one."""
    for kind in TEXTS:
        for pattern, table in ((_VERTEX, NUMBERS), (_FACE, NUMBERS | INDICES)):
            if pattern is _FACE and kind == "stl":
                continue
            lines, places = _places(kind, pattern)
            for (name, change), word in ((entry, word) for entry in table.items() for word in (1, -1)):
                place = places[len(name) % 3]
                words = lines[place].split()
                words[word] = change(words[word])
                reason = OTHER_INDICES.get((kind, name), "") if pattern is _FACE else ""
                title = f"{kind}: {name}, word {word} of line {place + 1}"
                yield Case(title, _with_line(kind, lines, place, " ".join(words)), reason)


LINES = {
    "gone": (lambda line: [], {"obj f": GONE, "plain.obj f": GONE}),
    "twice": (lambda line: [line, line], {}),
    "blank after": (lambda line: [line, "", " \t "], {}),
    "in two lines": (lambda line: [line.rpartition(" ")[0], line.rpartition(" ")[2]], {}),
    "in two lines with a backslash": (lambda line: [line.rpartition(" ")[0] + " \\", line.rpartition(" ")[2]], {}),
    "a backslash and a space": (lambda line: [line.rpartition(" ")[0] + " \\ ", line.rpartition(" ")[2]], {}),
    "tabs": (lambda line: [line.strip().replace(" ", "\t")], {}),
    "spaces": (lambda line: ["  " + line.replace(" ", "   ") + "  "], {}),
    "no-break spaces": (lambda line: [line.strip().replace(" ", "\u00a0")], {}),
    "wide spaces": (lambda line: [line.strip().replace(" ", "\u3000")], {}),
    "a no-break space first": (lambda line: ["\u00a0" + line], {}),
    "a mark first": (lambda line: ["\ufeff" + line], {}),
    "a NUL first": (lambda line: ["\0" + line], {}),
    "no spaces": (lambda line: [line.replace(" ", "")], {}),
    "commas": (lambda line: [line.strip().replace(" ", ", ")], {}),
    "semicolon": (lambda line: [line + ";"], {}),
    "a comment": (lambda line: ["# " + line], {"obj f": GONE, "plain.obj f": GONE}),
    "one number less": (lambda line: [line.rpartition(" ")[0]], {}),
    "one number more": (
        lambda line: [line + " 1"],
        {"plain.obj f": "a corner more is sound"},  # In the other it lacks uv, of which a warning tells.
    ),
    "two numbers more": (lambda line: [line + " 1 1"], {}),
    "text after": (lambda line: [line + " end"], {}),
    "a comment after": (lambda line: [line + " # end"], {}),
    "joined with itself": (lambda line: [line + " " + line], {}),
    "upper case": (lambda line: [line.upper()], {}),
    "quoted": (lambda line: [f'"{line}"'], {}),
    "escape": (lambda line: ["\x1b[0m" + line], {}),
}
KEYS = "F ff f1 fv V VV vv f: f, f/ vf fn ft v1 v: Vt VN vtt n nv".split()
KEYS += ("-", "1", "0.5", "f_", "\u0192", "\uff46", "\u00a0f", "f\u00a0", "fo", "v.", "face", "vertex", "poly", "//")
STL_WORDS = {
    "vertex": ("vertx", "vertexx", "Vertex", "vertex1", "", "vertex vertex", "vertex:"),
    "facet": ("face", "facets", "FACET", "", "facet facet"),
    "outer loop": ("outer", "loop", "Outer  Loop", "", "outerloop"),
    "endloop": ("end loop", "ENDLOOP", "", "endloop endloop"),
    "endfacet": ("end facet", "endFacet", "", "endfacett"),
    "endsolid": ("end solid", "EndSolid", "", "endsolids"),
    "solid": ("solids", "SOLID", "", "solid\u00a0"),
}


def line_cases():
    """One line of a text changed, as far as words and spaces go."""
    for kind in TEXTS:
        for pattern, row in ((_VERTEX, "v"), (_FACE, "f")):
            lines, places = _places(kind, pattern)
            for name, (change, reasons) in LINES.items():
                place = places[len(name) % 3]
                made = _with_line(kind, lines, place, *change(lines[place]))
                yield Case(f"{kind}: {name}, line {place + 1}", made, reasons.get(f"{kind} {row}", ""))
            for key in KEYS if kind.endswith("obj") else ():
                for place in places[:2]:
                    old, rest = lines[place].split(" ", 1)
                    for joined in (f"{key} {rest}", f"{key}{rest}"):
                        if joined.startswith(("v ", "f ", "vt ", "vn ")):
                            continue
                        title = f"{kind}: {old!r} of line {place + 1} is {joined[:9]!r}"
                        yield Case(title, _with_line(kind, lines, place, joined))
    for word, others in STL_WORDS.items():
        for other in others:
            whole = re.sub(rf"\b{word}\b", other, TEXTS["stl"])
            first = re.sub(rf"\b{word}\b", other, TEXTS["stl"], count=1)
            yield Case(f"stl: every {word!r} is {other!r}", model("stl", whole))
            yield Case(f"stl: the first {word!r} is {other!r}", model("stl", first))


# -------------------------------------------------------------------------------------------------- whole texts

WHOLE = {
    "CR": lambda x: x.replace("\n", "\r"),
    "CR LF": lambda x: x.replace("\n", "\r\n"),
    "CR CR LF": lambda x: x.replace("\n", "\r\r\n"),
    "LF CR": lambda x: x.replace("\n", "\n\r"),
    "CR from the middle on": lambda x: x[: len(x) // 2] + x[len(x) // 2 :].replace("\n", "\r"),
    "CR up to the middle": lambda x: x[: len(x) // 2].replace("\n", "\r") + x[len(x) // 2 :],
    "next lines": lambda x: x.replace("\n", "\x85"),
    "line separators": lambda x: x.replace("\n", "\u2028"),
    "form feeds": lambda x: x.replace("\n", "\f"),
    "vertical tabs": lambda x: x.replace("\n", "\v"),
    "a form feed in a comment": lambda x: x.replace("sheet\n", "sheet\f\n", 1),
    "one line": lambda x: x.replace("\n", " "),
    "no end of the last line": lambda x: x.rstrip("\n"),
    "blank lines": lambda x: x.replace("\n", "\n\n"),
    "blank lines first": lambda x: "\n\n" + x,
    "a mark": lambda x: "\ufeff" + x,
    "two marks": lambda x: "\ufeff\ufeff" + x,
    "UTF-16": lambda x: x.encode("utf-16"),
    "UTF-32": lambda x: x.encode("utf-32"),
    "tabs": lambda x: x.replace(" ", "\t"),
    "lower case": lambda x: x.lower(),
    "upper case": lambda x: x.upper(),
    "arabic digits": lambda x: x.translate(ARABIC),
    "no-break spaces": lambda x: x.replace(" ", "\u00a0"),
    "commas for points": lambda x: x.replace(".", ","),
    "NULs at the end": lambda x: x + "\0" * 9,
    "control Z at the end": lambda x: x + "\x1a",
    "blanks at the end": lambda x: x + "  \n\n\t\n",
    "blanks at ends of lines": lambda x: x.replace("\n", "  \t\n"),
    "latin-1 in the middle": lambda x: x[:60].encode() + b"\xe9" + x[60:].encode(),
    "an empty file": lambda x: "",
    "backwards": lambda x: "\n".join(reversed(x.splitlines())),
    "twice": lambda x: x + x,
}
OTHER_WHOLES = {("stl", "twice"): MORE}  # As two solids, which are parts of their own.


def whole_cases():
    """Texts changed as a whole, or cut short."""
    for kind, text in TEXTS.items():
        for name, change in WHOLE.items():
            yield Case(f"{kind}: {name}", model(kind, change(text)), OTHER_WHOLES.get((kind, name), ""))
        for at in np.linspace(1, len(text) - 3, 9).astype(int).tolist():
            whole = re.search(r"\nf( \S+){3}\n?$", text[:at]) and "\nf" in text[at:]
            yield Case(f"{kind}: cut at {at}", model(kind, text[:at]), GONE if whole else "")
    yield Case("obj: a comment that ends in a backslash", model("obj", TEXTS["obj"].replace("two\n", "two\n# C:\\\n")))
    facets = TEXTS["stl"].splitlines(keepends=True)
    two = "".join(facets[:29] + ["endsolid\nsolid b\n"] + facets[29:])
    yield Case("stl: two solids", model("stl", two))
    yield Case("stl: two solids without an end between", model("stl", two.replace("endsolid\n", "", 1)))
