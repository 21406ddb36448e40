"""Files with a fault each are read rightly, or refused by one error of one line; no other error reaches the caller."""

import json
import warnings
from functools import cache

import numpy as np
import pytest
import single_faults as faults
from helpers import arrays, quick, to_numpy
from lines import Lines
from posed import SIZE, binary_model, save, text_model
from test_colmap import CAMERAS, POINTS, images
from test_views import blender, llff

import rts
from rts import RtsError

pytestmark = pytest.mark.files

ADVICE = ("weights_only", "allow_pickle", "pickle.load", "set_int_max_str_digits")
"""Advice of others to switch a protection off."""


def outcome(call):
    """The result of a call, or None where it was refused as it ought to be; no warnings, and nothing else, may come."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return call()
        except RtsError as error:
            said = str(error)
            assert len(said.splitlines()) == 1 and said.isprintable(), said
            cause = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
            assert not [advice for advice in ADVICE if advice in f"{said} {cause}"], cause
            return None


def seen(path):
    """Views of a file, all of whose numbers are finite and within reach of float32's squares."""
    views = rts.load_views(path, **({"split": "all"} if path.suffix in (".bin", ".txt") else {}))
    for view in views:
        for matrix in (view.camera.view, view.camera.projection, view.camera.rays(view.size).directions):
            assert np.isfinite(matrix).all() and np.abs(matrix).max() < 1e19
        assert np.isfinite(view.image).all() and (view.mask is None or np.isfinite(view.mask).all())
    return views


def seeds(first, more):
    """Seeds of which `make test` tries the first ones, ten a test, and `make test-all` the rest."""
    return [
        pytest.param(range(10 * i, 10 * i + 10), id=str(i), marks=[pytest.mark.thorough] * (i >= first))
        for i in range(more)
    ]


# ------------------------------------------------------------------------------------------------------------- cameras


def nerf_tree(folder):
    """A tree of transforms.json with all that is read, and its pictures."""
    blender(folder, 2)
    tree = json.loads((folder / "transforms_train.json").read_text())
    tree |= {"fl_x": 10.0, "fl_y": 11.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6, "camera_model": "OPENCV"}
    tree |= {"k1": 0.02, "k2": 0.01, "p1": 0.001, "p2": 0.002}
    del tree["camera_angle_x"]
    tree["frames"][0]["mask_path"] = "train/r_1.png"
    tree["frames"][1] |= {"camera_model": None, "is_fisheye": True, "k3": 0.001, "k4": 0.001}
    return tree


def opencv_tree(folder):
    """A tree of cameras.json with all that is read, and its pictures."""
    blender(folder, 2)
    turn = np.eye(3).tolist()
    view = {"image": "train/r_0.png", "K": [[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]], "R": turn, "t": [0, 0, 3.0]}
    more = {"distortion": [0.1, 0.01, 0, 0], "fisheye": True, "width": 8, "height": 6, "mask": "train/r_1.png"}
    return {"views": [view, {**view, **more}]}


TREES = {"transforms.json": nerf_tree, "cameras.json": opencv_tree}


@pytest.mark.parametrize("chosen", seeds(6, 40))
@pytest.mark.parametrize("name", TREES)
def test_tampered_cameras_of_json_are_read_or_refused_in_one_line(tmp_path, name, chosen):
    folder = tmp_path / f"a{faults.MARK}b"
    tree = TREES[name](folder)
    path = folder / name
    path.write_text(json.dumps(tree))
    assert len(outcome(lambda: seen(path))) == 2
    for seed in chosen:
        path.write_bytes(faults.tampered_json(np.random.default_rng([seed, 1]), tree))
        outcome(lambda: seen(path))


@pytest.mark.parametrize("chosen", seeds(3, 15))
def test_tampered_cameras_of_llff_are_read_or_refused_in_one_line(tmp_path, chosen):
    folder = tmp_path / f"a{faults.MARK}b"
    rows = llff(folder)
    path = folder / "poses_bounds.npy"
    sound = path.read_bytes()
    for seed in chosen:
        random = np.random.default_rng([seed, 2])
        path.write_bytes(faults.tampered_bytes(random, sound))
        outcome(lambda: seen(path))
        changed = rows.copy()
        changed[random.integers(len(rows)), random.integers(17)] = faults.any_of(random, [5e-324, 1e300, -1e300, 0])
        np.save(path, changed)
        outcome(lambda: seen(path))


WRITERS = {"bin": binary_model, "txt": text_model}


@pytest.mark.parametrize("chosen", seeds(3, 20))
@pytest.mark.parametrize("table", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("form", WRITERS)
def test_tampered_models_of_colmap_are_read_or_refused_in_one_line(tmp_path, form, table, chosen):
    folder = tmp_path / f"a{faults.MARK}b"
    listed = images(2)
    WRITERS[form](folder / "sparse", CAMERAS, listed, POINTS[:6])
    for *_, name, _ in listed:
        save(folder / "images" / name, np.zeros(SIZE))
    path, cameras = (folder / f"sparse/{name}.{form}" for name in (table, "cameras"))
    assert len(outcome(lambda: seen(cameras))) == 2
    sound = path.read_bytes()
    for seed in chosen:
        random = np.random.default_rng([seed, 3])
        binary = form == "bin"
        path.write_bytes(
            faults.tampered_bytes(random, sound) if binary else faults.tampered_lines(random, sound.decode())
        )
        outcome(lambda: seen(cameras))


# --------------------------------------------------------------------------------------------------------- checkpoints

METHODS = quick(["torch-cpu adam", "torch-cpu sgd", "torch-cpu lm", "jax adam"], 3)


@cache
def residuals():
    return Lines(noise=1.0)


def fit(path, kind, steps=7):
    target, method = kind.split()
    parameters = arrays(target, {"p": np.zeros(3), "q": np.zeros((2, 2))})
    return rts.fit(residuals(), parameters, method=method, steps=steps, checkpoint=path, checkpoint_every=3)


def state_of(kind):
    """The function that tampers with the state of a method."""
    return faults.tampered_torch_state if kind.split()[1] != "lm" and "torch" in kind else faults.tampered_archive


@pytest.mark.parametrize("chosen", seeds(1, 12))
@pytest.mark.parametrize("kind", METHODS)
def test_tampered_checkpoints_are_gone_on_from_or_refused_in_one_line(tmp_path, kind, chosen):
    folder = tmp_path / f"a{faults.MARK}b"
    folder.mkdir()
    path = folder / "fit.npz"
    fit(path, kind)
    sound = path.read_bytes()
    whole = fit(tmp_path / "whole.npz", kind, 9)
    assert outcome(lambda: fit(path, kind, 9)).history == whole.history
    for seed in chosen:
        path.write_bytes(faults.tampered_checkpoint(np.random.default_rng([seed, 4]), sound, state_of(kind)))
        found = outcome(lambda: fit(path, kind, 9))
        if found is not None:
            assert all(np.isfinite(x).all() for x in to_numpy(found.parameters).values()) and np.isfinite(found.loss)
            assert all(type(loss) is float for loss in found.history)
