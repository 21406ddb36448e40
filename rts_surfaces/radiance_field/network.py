"""The network of a radiance field as functions of its weights; one code for NumPy, torch and jax.

    x = encoded(position), d = encoded(direction)
    h = layer1 x (no ReLU), then h = ReLU(layer h) for each layer of layers_xyz
    density = ReLU(fc_alpha h)
    g = ReLU(fc_feat h), then g = ReLU(layers_dir.0 [g, d]), then g = ReLU(layer g) for each later one of layers_dir
    rgb = sigmoid(fc_rgb g)

as in Mildenhall et al. 2020 (NeRF), in the smaller form of krrish94/nerf-pytorch. A layer is {"weight": (out, in),
"bias": (out,)}, and maps x to weight x + bias. The weights tell the number and widths of layers, and how many
frequencies encode positions and directions.

NumPy weights are constants beside points of torch or jax, in the dtype of the points; so are NumPy points beside
weights of torch or jax.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rts import InputError, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, constants, exemplar, shape_of
from rts.plugin_api.checks import quoted

SINGLE = ("layer1", "fc_alpha", "fc_feat", "fc_rgb")
REPEATED = ("layers_xyz", "layers_dir")


class Architecture(NamedTuple):
    """The architecture of a network, from the shapes of its weights.

    Attributes:
        position_levels: frequencies that encode positions: 2⁰ to 2^(levels − 1).
        direction_levels: frequencies that encode directions.
        width: units of the layers from which density is computed, layer1 and layers_xyz.
        layers: the number of these layers.
        parameters: the number of weights.
    """

    position_levels: int
    direction_levels: int
    width: int
    layers: int
    parameters: int


def check_network(weights: Any, name: str = "the network") -> Architecture:
    """The architecture of a network, after a check of its layers and their shapes; numbers are not looked at.

    Args:
        weights: {"layer1": layer, "layers_xyz": [layer, …], "fc_alpha", "fc_feat", "layers_dir": [layer, …],
            "fc_rgb"}, each layer a dict of "weight" and "bias".
        name: the network's name in errors.

    Raises:
        InputError: the weights are of no such network; the message names the layer.
    """
    if not isinstance(weights, Mapping):
        raise InputError(f"{name} is {quoted(weights)}; expected a dict of layers {', '.join(SINGLE + REPEATED)}")
    missing = [n for n in SINGLE + REPEATED if n not in weights]
    if missing:
        raise InputError(f"{name} lacks the layer {missing[0]!r}; expected {', '.join(SINGLE + REPEATED)}")
    for n in REPEATED:
        if not isinstance(weights[n], (list, tuple)) or not weights[n]:
            raise InputError(f"{name} has no list of layers {n!r}; expected at least one layer")
    count = 0

    def layer(place: str, arrays: Any, outputs: int | None, inputs: int | None) -> tuple[int, int]:
        nonlocal count
        if not isinstance(arrays, Mapping) or not {"weight", "bias"} <= set(arrays):
            raise InputError(f"{name} has no 'weight' and 'bias' of the layer {place!r}; expected both")
        shape, bias = shape_of(arrays["weight"]), shape_of(arrays["bias"])
        fits = len(shape) == 2 and 0 not in shape and bias == shape[:1]
        if not fits or (outputs or shape[0], inputs or shape[1]) != shape:
            expected = f"({outputs or 'n'}, {inputs or 'm'}) and ({outputs or 'n'},)"
            raise InputError(
                f"{name} has weights of shape {shape} and biases of shape {bias} in the layer {place!r}; "
                f"expected {expected}"
            )
        count += shape[0] * (shape[1] + 1)
        return shape[0], shape[1]

    def levels(place: str, encoded: int) -> int:
        if encoded < 3 or (encoded - 3) % 6:
            raise InputError(
                f"{name} has the layer {place!r} for {encoded} numbers; expected 3 + 6 for each frequency that encodes "
                f"a position or direction"
            )
        return (encoded - 3) // 6

    width, encoded = layer("layer1", weights["layer1"], None, None)
    position_levels = levels("layer1", encoded)
    for i, arrays in enumerate(weights["layers_xyz"]):
        layer(f"layers_xyz.{i}", arrays, width, width)
    layer("fc_alpha", weights["fc_alpha"], 1, width)
    features, _ = layer("fc_feat", weights["fc_feat"], None, width)
    narrow, joined = layer("layers_dir.0", weights["layers_dir"][0], None, None)
    direction_levels = levels("layers_dir.0", joined - features)
    for i, arrays in enumerate(weights["layers_dir"][1:], 1):
        layer(f"layers_dir.{i}", arrays, narrow, narrow)
    layer("fc_rgb", weights["fc_rgb"], 3, narrow)
    return Architecture(position_levels, direction_levels, width, 1 + len(weights["layers_xyz"]), count)


def encoding(vectors: Array, levels: int) -> Array:
    """Vectors beside their sines and cosines at frequencies 1, 2, 4, …, without a factor π.

    Args:
        vectors: (M, 3).
        levels: number of frequencies L.

    Returns:
        (M, 3 + 6 L): v, sin v, cos v, sin 2v, cos 2v, …
    """
    xp, engine = namespace(vectors), engine_of(vectors)
    if levels == 0:
        return vectors
    frequencies = engine.constant([[2.0**i] for i in range(levels)], vectors)
    angles = vectors[:, None, :] * frequencies
    waves = xp.reshape(xp.stack([xp.sin(angles), xp.cos(angles)], axis=2), (vectors.shape[0], 6 * levels))
    return xp.concat([vectors, waves], axis=1)


def density(weights: Mapping[str, Tree], points: Array) -> Array:
    """Volume density σ at points: the share of light that a ray loses per unit of length in the field's space.

    Args:
        weights: a network, see `check_network`.
        points: (M, 3) in the field's space.

    Returns:
        (M,), at least zero.
    """
    weights, points = _alike(weights, points)
    return _density(weights, _trunk(weights, points))


def radiance(weights: Mapping[str, Tree], points: Array, directions: Array) -> Array:
    """Colours seen along directions.

    Args:
        weights: a network, see `check_network`.
        points: (M, 3) in the field's space.
        directions: (M, 3) unit vectors away from the viewer, in the world.

    Returns:
        (M, 3) RGB in [0, 1], encoded as the images that the field was trained on: sRGB, as a rule.
    """
    weights, points, directions = _alike(weights, points, directions)
    return _radiance(weights, _trunk(weights, points), directions)


def density_and_radiance(weights: Mapping[str, Tree], points: Array, directions: Array) -> tuple[Array, Array]:
    """Density (M,) and colours (M, 3), by one evaluation; see `density` and `radiance`."""
    weights, points, directions = _alike(weights, points, directions)
    hidden = _trunk(weights, points)
    return _density(weights, hidden), _radiance(weights, hidden, directions)


def _alike(*trees: Tree) -> tuple[Any, ...]:
    """The trees, NumPy arrays made constants in the engine and dtype of those of torch or jax, if there are any."""
    return constants(trees, engine_of(trees), exemplar(trees))


def _trunk(weights: Mapping[str, Any], points: Array) -> Array:
    inputs = weights["layer1"]["weight"].shape[1]
    hidden = _layer(weights["layer1"], encoding(points, (inputs - 3) // 6))
    for layer in weights["layers_xyz"]:
        hidden = _relu(_layer(layer, hidden))
    return hidden


def _density(weights: Mapping[str, Any], hidden: Array) -> Array:
    return _relu(_layer(weights["fc_alpha"], hidden))[:, 0]


def _radiance(weights: Mapping[str, Any], hidden: Array, directions: Array) -> Array:
    first: Sequence[Any] = weights["layers_dir"]
    features = _relu(_layer(weights["fc_feat"], hidden))
    inputs = first[0]["weight"].shape[1] - features.shape[1]
    layer_values = namespace(features).concat([features, encoding(directions, (inputs - 3) // 6)], axis=1)
    for layer in first:
        layer_values = _relu(_layer(layer, layer_values))
    layer_values = _layer(weights["fc_rgb"], layer_values)
    return 0.5 * namespace(layer_values).tanh(0.5 * layer_values) + 0.5  # The sigmoid, without overflow.


def _layer(layer: Mapping[str, Array], x: Array) -> Array:
    xp = namespace(x)
    return xp.matmul(x, xp.matrix_transpose(layer["weight"])) + layer["bias"]


def _relu(x: Array) -> Array:
    xp = namespace(x)
    return xp.maximum(x, xp.zeros_like(x[:1, :1]))  # NaN stays NaN.


def placed(weights: Tree, place: tuple = ()) -> Iterator[tuple[tuple, Array]]:
    """The arrays of nested dicts and lists, sorted, each with the keys and indices that lead to it."""
    if not isinstance(weights, (Mapping, list, tuple)):
        yield place, weights
        return
    for key in sorted(weights) if isinstance(weights, Mapping) else range(len(weights)):
        yield from placed(weights[key], (*place, key))
