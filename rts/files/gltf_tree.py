"""The tree of GLB and glTF files, and the bytes and pictures that it refers to."""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import Fail, unreadable, warn
from rts.files.images import decoded

APPEARANCE = re.compile(r"[A-Z]+_(materials|lights|texture|xmp|animation)")
"""Names of extensions that do not concern shapes begin like this."""
READ = frozenset(
    f"KHR_{name}"
    for name in "mesh_quantization materials_unlit materials_emissive_strength materials_pbrSpecularGlossiness "
    "materials_specular lights_punctual".split()
)
UNSEEN = re.compile(r"[A-Z]+_(texture|xmp|animation)")
"""Names of extensions begin like this that are read, or that make no difference to what is loaded."""
LIGHTS = "KHR_lights_punctual"
"""The extension of lights."""
TOLD = "EXT_mesh_gpu_instancing"
"""An extension of which reading scenes warns."""
_COPY = "decode it by `gltf-transform copy model.glb decoded.glb`, of the package @gltf-transform/cli of npm"
DECODERS = {
    "KHR_draco_mesh_compression": f"{_COPY}, or export it again from Blender, without compression",
    "EXT_meshopt_compression": f"{_COPY}, or by gltfpack without its option -c",
    "KHR_meshopt_compression": "export it again without compression, such as by gltfpack without its option -c",
}
"""Advice about an extension that is not read."""
LISTS = frozenset(
    "accessors animations buffers bufferViews cameras images materials meshes nodes samplers scenes skins "
    "textures".split()
)
"""Lists of objects of the whole."""
_INNER_LISTS = {"primitives", "targets", "channels"}
_INNER_OBJECTS = {"extensions", "attributes", "sparse", "pbrMetallicRoughness", "perspective", "orthographic"}
PROPERTIES = {
    "accessors": "bufferView byteOffset componentType normalized count type max min sparse",
    "bufferViews": "buffer byteOffset byteLength byteStride target",
    "meshes": "primitives weights",
    "primitives": "attributes indices material mode targets",
    "nodes": "camera children skin matrix mesh rotation scale translation weights",
    "scenes": "nodes",
}
"""Properties of each kind of object, beside a name, extensions and extras."""
ATTRIBUTE = re.compile(r"POSITION|NORMAL|TANGENT|(TEXCOORD|COLOR|JOINTS|WEIGHTS)_[0-9]+|_.*")


def count_of(value: Any) -> int:
    """The value if it is a whole number of at least zero; else a ValueError."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is no count")
    return value


class Gltf:
    """An open GLB or glTF.

    Args:
        path: its path.
        data: its bytes.
        file: name → bytes of a file that it refers to.

    Attributes:
        path: its path.
        fail: text → error.
        tree: its JSON.
        views: the bytes of each bufferView.
        notes: what is not followed → the names of where it is.

    Raises:
        InputError: it is shorter than it promises, a part is missing or unsound, or it needs what is not read.
    """

    def __init__(self, path: Path, data: bytes, file: Callable[[str], bytes]):
        self.path, self._file, self._pictures = path, file, {}
        self.notes: dict[str, list[str]] = {}
        kind = "GLTF" if path.suffix.lower() == ".gltf" else "GLB"
        self.fail: Fail = lambda what: unreadable(path, kind, what)
        text, self._binary = self._parts(data) if kind == "GLB" else (data, None)
        self.tree: dict[str, Any] = self.part("its tree", _tree, text)
        if wrong := _wrong_kind(self.tree):
            raise self.fail(f"its tree: {wrong}")
        self.part("its tree", self._check_extensions)
        self._buffers = self.each("buffers", self._buffer)
        self.views = self.each("bufferViews", self._view)

    def part(self, name: str, read: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function of a part of the file; whatever it raises is an error that names the part."""
        try:
            return read(*arguments)
        except InputError:
            raise
        except Exception as error:  # Anything may be missing, or of another kind.
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            raise self.fail(f"{name}: {f'{error} is missing' if isinstance(error, KeyError) else said}") from error

    def compressed(self, what: str, extensions: list[str]) -> InputError:
        """The error of a file that needs extensions which are not read: what is wrong, and what to do about these."""
        known = [DECODERS[name] for name in extensions if name in DECODERS]
        advice = known[0] if known else "export it again without this extension"
        return InputError(f"{self.path} cannot be read ({what}); {advice}")

    def each(self, kind: str, read: Callable[[int, Any], Any]) -> list[Any]:
        """The results of a function (index, JSON) of all objects of a kind, such as "accessors"."""
        name = "mesh" if kind == "meshes" else kind[:-1]
        entries = self.part("its tree", lambda: list(enumerate(self.tree.get(kind, []))))
        return [self.part(f"{name} {i}", read, i, entry) for i, entry in entries]

    def uses(self, extension: str) -> bool:
        """True if the file says that it uses or requires the extension."""
        return extension in (*self.tree.get("extensionsUsed", []), *self.tree.get("extensionsRequired", []))

    def note(self, what: str, name: str) -> None:
        """Note that something is not followed; `warn_of_notes` tells of it."""
        self.notes.setdefault(what, []).append(name)

    def warn_of_notes(self) -> None:
        """Warn of what is not followed, each with the first places where it is."""
        for what, names in self.notes.items():
            names = list(dict.fromkeys(names))
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            warn(f"{self.path} has {what}: {', '.join(names[:3])}{more}")

    def picture(self, texture: int, name: str) -> np.ndarray | None:
        """The pixels of a texture, as `rts.files.images.pixels` gives them; None with a warning if of an unknown kind.

        `name` is for errors.
        """
        entry = self.tree["textures"][count_of(texture)]
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", entry.get("source"))
        if source is None:
            warn(f"{self.path}: {name} is of a kind that is not read; it is loaded without")
            return None
        if count_of(source) not in self._pictures:
            image = self.tree["images"][source]
            content = self.views[count_of(image["bufferView"])] if "bufferView" in image else self._named(image["uri"])
            self._pictures[source] = decoded(content, name, self.fail)
        return self._pictures[source]

    def check_names(self) -> None:
        """Warn of properties that the format does not know, which may be others misspelt."""
        lists = {kind: self.tree.get(kind, []) for kind in PROPERTIES}
        lists["primitives"] = [p for mesh in lists["meshes"] for p in mesh["primitives"]]
        unknown = []
        for kind, objects in lists.items():
            known = {*PROPERTIES[kind].split(), "name", "extensions", "extras"}
            unknown += [f"{name!r} of {kind} {i}" for i, entry in enumerate(objects) for name in {*entry} - known]
        for i, primitive in enumerate(lists["primitives"]):
            unknown += [f"{n!r} of primitives {i}" for n in primitive["attributes"] if not ATTRIBUTE.fullmatch(n)]
        if unknown:
            warn(f"{self.path} has properties that glTF does not know, and that are left out: {', '.join(unknown[:5])}")

    def _parts(self, data: bytes) -> tuple[bytes, bytes | None]:
        """The JSON of a GLB, and its binary part, which is the first buffer's."""
        if len(data) < 20 or data[:4] != b"glTF":
            raise self.fail("it does not begin with 'glTF' and a header of 20 bytes")
        version, length = struct.unpack_from("<II", data, 4)
        if version != 2:
            raise self.fail(f"its header says version {version}; expected 2")
        if length > len(data):
            raise self.fail(f"its header promises {length} bytes, and it has {len(data)}")
        if length < len(data):
            warn(f"{self.path}: the {len(data) - length} bytes after the end that its header gives are not read")
        at, parts = 12, []
        while at < length:
            size, kind = struct.unpack_from("<I4s", data, at) if at + 8 <= length else (length, b"")
            if at + 8 + size > length:
                raise self.fail(f"a part of it promises {size} bytes, and {max(length - at - 8, 0)} are left")
            parts.append((kind, data[at + 8 : at + 8 + size]))
            at += 8 + size
        if not parts or parts[0][0] != b"JSON":
            raise self.fail("its first part is no JSON")
        return parts[0][1], next((content for kind, content in parts[1:] if kind == b"BIN\0"), None)

    def _check_extensions(self) -> None:
        """Refuse other versions, and extensions that are needed and not read; warn of those that are only used."""
        tree, asset = self.tree, self.tree.get("asset", {})
        if not str(asset.get("version", "2")).startswith("2") or str(asset.get("minVersion", "2.0")) != "2.0":
            version = asset.get("minVersion", asset.get("version"))
            raise self.fail(f"it is of version {version!r} of glTF; expected 2.0")
        required = tree.get("extensionsRequired", [])
        unknown = [name for name in required if name not in READ and not APPEARANCE.match(str(name))]
        if unknown:
            raise self.compressed(f"it requires the extension {unknown[0]!r}, which is not read", unknown)
        holders = [*tree.get("bufferViews", []), *(p for mesh in tree.get("meshes", []) for p in mesh["primitives"])]
        holders += tree.get("materials", [])
        used = [*tree.get("extensionsUsed", []), *(name for holder in holders for name in holder.get("extensions", {}))]
        unread = [name[:60] for name in dict.fromkeys(used) if name not in (*READ, TOLD) and not UNSEEN.match(name)]
        if unread:
            what = f"{unread[0]}, which is" if len(unread) == 1 else f"{', '.join(unread[:9])}, which are"
            plural = "s" if len(unread) > 1 else ""
            warn(f"{self.path} uses the extension{plural} {what} not read; it is loaded as it is without")

    def _buffer(self, index: int, buffer: dict[str, Any]) -> bytes:
        extensions, content = buffer.get("extensions", {}), b""
        if buffer.get("uri") is not None:
            content = self._named(buffer["uri"])
        # A buffer of compression's may stand for data that are nowhere.
        elif index == 0 and not any(extension.get("fallback") for extension in extensions.values()):
            content = self._binary or b""
        promised = count_of(buffer["byteLength"])
        if promised > len(content):
            what = f"buffer {index} promises {promised} bytes, and has {len(content)}"
            if extensions:
                unread = f"{what}, and the extension that has them is not read: {', '.join(extensions)}"
                raise self.compressed(unread, [*extensions])
            raise self.fail(what)
        return content

    def _named(self, uri: str) -> bytes:
        """The bytes of a file, or those in the name itself."""
        if not uri.startswith("data:"):
            return self._file(uri)
        try:
            return base64.b64decode(uri.partition("base64,")[2], validate=True)
        except binascii.Error as error:
            raise self.fail(f"there are data that are not base64: {error}") from None

    def _view(self, index: int, view: dict[str, Any]) -> bytes:
        start, length = count_of(view.get("byteOffset", 0)), count_of(view["byteLength"])
        content = self._buffers[count_of(view["buffer"])]
        if start + length > len(content):
            raise self.fail(f"bufferView {index} ends at byte {start + length} of {len(content)}")
        return content[start : start + length]


def _tree(text: bytes) -> dict[str, Any]:
    tree = json.loads(text, parse_constant=_no_number, object_pairs_hook=_unique)
    if not isinstance(tree, dict):
        raise ValueError("the whole is no object")
    return tree


def _wrong_kind(tree: dict[str, Any]) -> str:
    """Which part of the tree is no list or object, though it ought to be one; "" if all are what they ought to be."""
    for name in ("extensionsUsed", "extensionsRequired"):
        if not _is_list(tree.get(name, []), str):
            return f"{name} is {_shown(tree[name])}; expected a list of names"
    if not isinstance(tree.get("asset", {}), dict):
        return f"asset is {_shown(tree['asset'])}; expected an object"
    for name in sorted(LISTS & {*tree}):
        if not _is_list(tree[name], dict):
            return f"{name} is {_shown(tree[name])}; expected a list of objects"
    ahead = [(f"{name} {i}", entry) for name in sorted(LISTS & {*tree}) for i, entry in enumerate(tree[name])]
    while ahead:
        place, entry = ahead.pop()
        for name, value in entry.items():
            if name in _INNER_LISTS and not _is_list(value, dict):
                return f"{name} of {place} is {_shown(value)}; expected a list of objects"
            if name in _INNER_OBJECTS and not isinstance(value, dict):
                return f"{name} of {place} is {_shown(value)}; expected an object"
            if name == "extensions" and (wrong := [key for key, x in value.items() if not isinstance(x, dict)]):
                return f"{wrong[0][:60]} of {place} is {_shown(value[wrong[0]])}; expected an object"
            if name in _INNER_LISTS - {"targets"}:
                ahead += [(place, inner) for inner in value]
            elif name == "extensions":
                ahead += [(place, inner) for inner in value.values()]
    return ""


def _is_list(value: Any, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(entry, kind) for entry in value)


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number in JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError(f"one of {', '.join(members)[:60]} is there twice")
    return members
