"""A small radiance field of random weights."""

import numpy as np

from rts_surfaces.radiance_field.field import RadianceField


def network(seed=0, levels=(3, 2), width=8, narrow=6):
    """Random weights of a small network, float32."""
    rng = np.random.default_rng(seed)

    def layer(outputs, inputs):
        weight = rng.standard_normal((outputs, inputs)) / inputs**0.5
        return {"weight": weight.astype(np.float32), "bias": (0.3 * rng.standard_normal(outputs)).astype(np.float32)}

    alpha = layer(1, width)
    return {
        "layer1": layer(width, 3 + 6 * levels[0]),
        "layers_xyz": [layer(width, width), layer(width, width)],
        "fc_alpha": {"weight": 3 * alpha["weight"], "bias": 0 * alpha["bias"]},
        "fc_feat": layer(width, width),
        "layers_dir": [layer(narrow, width + 3 + 6 * levels[1])],
        "fc_rgb": layer(3, narrow),
    }


FIELD = RadianceField({"coarse": network(2), "fine": network(6)})
