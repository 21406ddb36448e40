"""Sheets with damaged headers, and binary ones with bytes that are flipped, lost or too many."""

from sheets import BINARIES, BROKEN, TEXTS, Case, model

COUNTS = (
    *"+{} 0{} {}.0 -{} {}_ {}e0 0x{} nine 0 7 10 4000000000 \u0669 {}, \u2079".split(),
    *("", "\u00a0{}", "{} {}"),
)


def header_cases():
    """Headers of PLY and OFF."""
    ply = {"ply": TEXTS["ply"].encode(), "little.ply": BINARIES["little.ply"], "big.ply": BINARIES["big.ply"]}
    for kind, data in ply.items():
        for element, count in (("vertex", "9"), ("face", "8")):
            for form in COUNTS:
                other = form.replace("{}", count)
                old, new = f"element {element} {count}", f"element {element} {other}"
                yield Case(f"{kind}: {new!r}", model(kind, data.replace(old.encode(), new.encode())))
        end = data.index(b"end_header\n") + 11
        lines = data[:end].splitlines(keepends=True)
        for i, line in enumerate(lines):
            for name, those in {"gone": [], "twice": [line, line], "in capitals": [line.upper()]}.items():
                header = b"".join([*lines[:i], *those, *lines[i + 1 :]])
                yield Case(f"{kind}: line {i + 1} {name}", model(kind, header + data[end:]))
        for name, finish in {"CR": b"\r", "CR LF": b"\r\n", "LF CR": b"\n\r"}.items():
            yield Case(f"{kind}: a header with {name}", model(kind, data[:end].replace(b"\n", finish) + data[end:]))
        for old, new in {
            **{"float x": "double x", "float y": "int y", "uchar int": "int int", "uchar int ": "uchar uint "},
            **{"uchar int  ": "uchar short ", "list uchar": "list float", "float z": "float Z", "1.0": "2.0"},
            **{"big": "little", "little": "big", "ascii": "binary_little_endian", "binary_little_endian": "ascii"},
            **{"property float x": "property x", "property list": "property  list", "vertex_indices": "vertex_index"},
            **{"element face": "element fbce", "element vertex": "element vertices", "comment": "commant"},
        }.items():
            changed = data[:end].replace(old.strip().encode(), new.strip().encode(), 1)
            if changed != data[:end]:
                reason = "integers are coordinates as well" if "int y" in new and kind != "ply" else ""
                yield Case(f"{kind}: {old!r} is {new!r}", model(kind, changed + data[end:]), reason)
    for form in COUNTS:
        for i, count in enumerate("980"):
            counts = [*"980"]
            counts[i] = form.replace("{}", count)
            text = TEXTS["off"].replace("9 8 0", " ".join(counts))
            yield Case(f"off: {' '.join(counts)!r}", model("off", text))
    for word in (
        *"off Off coff COFF NOFF STOFF 4OFF nOFF OFFX OF OFF: \u039fFF".split(),
        *("OFF BINARY", "", "# off", "OFF\u00a0"),
    ):
        yield Case(f"off: begins with {word!r}", model("off", TEXTS["off"].replace("OFF", word)))
    yield Case("off: counts in the first line", model("off", TEXTS["off"].replace("OFF\n", "OFF ")))
    yield Case("off: counts joined with the first word", model("off", TEXTS["off"].replace("OFF\n", "OFF")))
    yield Case("off: comments", model("off", "# a\n" + TEXTS["off"].replace("\n", " # c \u00e9 1\n")))


# -------------------------------------------------------------------------------------------------------- bytes


def byte_cases():
    """Bytes of binary files flipped, inserted, taken away."""
    for kind, data in BINARIES.items():
        head = {"binary.stl": 84, "glb": 20}.get(kind) or data.index(b"end_header\n") + 11
        for place in range(0, head, 1 if kind == "glb" else 5):
            flipped = bytearray(data)
            flipped[place] ^= 1 << (place * 5 + 3) % 8
            yield Case(f"{kind}: bit {(place * 5 + 3) % 8} of byte {place}", model(kind, bytes(flipped)))
        for share in (0, 0.2, 0.3, 0.5, 0.7, 0.9):
            at = int(share * len(data))
            for name, changed in {
                "a byte more": data[:at] + b"\x07" + data[at:],
                "a byte more, one less at the end": data[:at] + b"\x07" + data[at:-1],
                "a byte less": data[:at] + data[at + 1 :],
                "a byte less, one more at the end": data[:at] + data[at + 1 :] + b"\0",
                "two bytes less, two more at the end": data[:at] + data[at + 2 :] + b"\0\0",
                "LF to CR LF": data.replace(b"\n", b"\r\n"),
                "cut": data[:at],
            }.items():
                yield Case(f"{kind}: {name} at {at}", model(kind, changed))
    stl = BINARIES["binary.stl"]
    for first in range(9):
        for by in (1, 2, 3, -1, -2, -3):
            at = 84 + 50 * first if first < 8 else 84
            moved = stl[:at] + bytes(by) + stl[at:-by] if by > 0 else stl[:at] + stl[at - by :] + bytes(-by)
            if first < 7:
                yield Case(f"binary.stl: shifted by {by} from triangle {first}", model("stl", moved))
    for kind, place in (("binary.stl", 99), ("little.ply", len(BINARIES["little.ply"]) - 8 * 13 - 2)):
        flipped = bytearray(BINARIES[kind])
        flipped[place] ^= 64
        yield Case(f"{kind}: bit 6 of byte {place} in the data", model(kind, bytes(flipped)), BROKEN)
