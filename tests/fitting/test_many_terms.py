"""Fits of residuals of many terms: batches, validation, optimiser objects, rates, checkpoints."""

import json
import pickle
import traceback

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, quick, to_numpy
from lines import MATRIX, SOLUTION, Lines

import rts
from rts.errors import InputError, RtsError, RtsWarning
from rts.fitting import checkpoint as checkpoints

pytestmark = pytest.mark.fitting

targets = pytest.mark.parametrize("target", quick(DIFFERENTIABLE))


def start(target="torch-cpu"):
    return arrays(target, {"p": np.zeros(3)})


def loss_of(p, terms=range(12), noise=0.0):
    """The mean loss of terms, by NumPy."""
    shift = noise * np.random.default_rng(1).normal(size=(12, 4))
    return np.mean([((MATRIX[i] @ (to_numpy(p) - SOLUTION) - shift[i]) ** 2).mean() for i in terms])


# ------------------------------------------------------------------------------------------------------- terms


@targets
@pytest.mark.parametrize("method", ["adam", "lm"])
def test_the_loss_is_the_mean_of_the_terms_losses(target, method):
    fit = rts.fit(Lines(), start(target), method=method, steps=60, learning_rate=None if method == "lm" else 0.2)
    assert fit.history[0] == pytest.approx(loss_of(np.zeros(3)), rel=1e-5)
    np.testing.assert_allclose(to_numpy(fit.parameters)["p"], SOLUTION, atol=2e-2 if method == "adam" else 1e-4)
    assert fit.validated == []


@targets
def test_a_step_is_that_of_the_batchs_gradient(target):
    seen = []
    rts.fit(
        Lines(batch=2), start(target), method="sgd", steps=2, learning_rate=0.1, callback=lambda k, p, v: seen.append(p)
    )
    gradient = np.mean([-2 * MATRIX[i].T @ MATRIX[i] @ SOLUTION / 4 for i in (0, 1)], axis=0)
    np.testing.assert_allclose(to_numpy(seen[1])["p"], -0.1 * gradient, rtol=1e-4)


def test_lm_refuses_batches():
    with pytest.raises(InputError, match="needs all terms"):
        rts.fit(Lines(batch=2), start(), method="lm")


def test_a_step_without_terms_is_refused():
    with pytest.raises(InputError, match="drew no term"):
        rts.fit(Lines(terms=()), start())


# -------------------------------------------------------------------------------------------------- validation


def test_the_best_of_batches_is_that_of_all_terms():
    fit = rts.fit(Lines(batch=3, noise=1.0), start(), steps=41, learning_rate=0.2, validate_every=10)
    assert [step for step, _ in fit.validated] == [0, 10, 20, 30, 40]
    assert fit.loss == min(loss for _, loss in fit.validated)
    assert fit.loss == pytest.approx(loss_of(fit.parameters["p"], noise=1.0), rel=1e-4)
    assert min(fit.history) < fit.loss  # A batch may fit better than all.


def test_views_that_are_held_out_decide():
    kept, held = range(9), range(9, 12)
    validation = Lines(terms=held, noise=3.0)
    fit = rts.fit(
        Lines(terms=kept, noise=3.0),
        start(),
        steps=300,
        learning_rate=0.05,
        validation=validation,
        validate_every=1,
        patience=1000,
    )
    losses = [loss for _, loss in fit.validated]
    assert losses[0] == pytest.approx(loss_of(np.zeros(3), held, 3.0), rel=1e-4)
    assert fit.loss == min(losses) < losses[-1]  # It fits the noise of the others in the end.
    assert set(validation.loads) == set(held)


def test_validations_take_a_fifth_of_the_terms_unless_told_otherwise():
    residuals = Lines(batch=3)
    fit = rts.fit(residuals, start(), steps=100, learning_rate=1e-9, patience=1000)
    assert len(fit.validated) == 8  # Every 16 steps of 3 terms 12 terms: 0, 16, …, 96, and at the end.
    assert len(residuals.loads) == 100 * 3 + 8 * 12


def test_patience_counts_where_losses_decide():
    fit = rts.fit(Lines(batch=3), start(), steps=500, learning_rate=1e-12, validate_every=10, patience=25)
    assert "no gain in 25 steps" in fit.reason
    assert fit.steps == 31  # The gain of the first step, and the first validation at least 25 steps later.


# -------------------------------------------------------------------------------------------- optimisers, rates


def test_a_torch_optimiser_steps_a_copy():
    torch = pytest.importorskip("torch")
    p = {"p": torch.zeros(3), "q": torch.ones(2)}
    optimizer = torch.optim.SGD([{"params": [p["p"]], "lr": 0.1}, {"params": [p["q"]], "lr": 0.01}], momentum=0.9)
    seen = []
    rts.fit(
        lambda x: torch.cat([x["p"] - 1, x["q"]]), p, method=optimizer, steps=3, callback=lambda k, x, v: seen.append(x)
    )
    own = {name: x.clone().requires_grad_() for name, x in p.items()}
    step = torch.optim.SGD([{"params": [own["p"]], "lr": 0.1}, {"params": [own["q"]], "lr": 0.01}], momentum=0.9)
    for x in seen:
        for name in own:
            torch.testing.assert_close(x[name], own[name].detach(), rtol=1e-6, atol=0)
        step.zero_grad()
        torch.cat([own["p"] - 1, own["q"]]).square().mean().backward()
        step.step()
    assert not p["p"].any() and not optimizer.state


def test_tensors_that_the_optimiser_does_not_hold_stay():
    torch = pytest.importorskip("torch")
    p = {"p": torch.zeros(3), "q": torch.ones(2)}
    fit = rts.fit(lambda x: torch.cat([x["p"] - 1, x["q"]]), p, method=torch.optim.Adam([p["p"]], lr=0.1), steps=20)
    assert bool((fit.parameters["q"] == 1).all()) and bool((fit.parameters["p"] > 0.5).all())


def test_an_optimiser_of_optax():
    optax = pytest.importorskip("optax")
    method = optax.multi_transform({"fast": optax.sgd(0.1), "slow": optax.sgd(0.01)}, {"p": "fast", "q": "slow"})
    p = arrays("jax", {"p": np.zeros(3), "q": np.ones(1)})
    seen = []
    jnp = pytest.importorskip("jax").numpy
    rts.fit(
        lambda x: jnp.concatenate([x["p"] - 1, x["q"]]),
        p,
        method=method,
        steps=2,
        callback=lambda k, x, v: seen.append(x),
    )
    np.testing.assert_allclose(to_numpy(seen[1])["p"], np.full(3, 0.05), rtol=1e-5)  # 0.1 · 2 / 4
    np.testing.assert_allclose(to_numpy(seen[1])["q"], [0.995], rtol=1e-6)


@targets
def test_rates_by_name(target):
    p = arrays(target, {"a": {"x": np.ones(2), "y": np.ones(2)}, "b": np.ones(2)})
    seen = []
    rts.fit(
        lambda t: t["a"]["x"] + t["a"]["y"] + t["b"],
        p,
        steps=2,
        learning_rate={"a": 0.1, "a.y": 0.2, "b": 0.01},
        callback=lambda k, x, v: seen.append(to_numpy(x)),
    )
    # Adam's first step is the rate.
    np.testing.assert_allclose(
        [seen[1]["a"]["x"][0], seen[1]["a"]["y"][0], seen[1]["b"][0]], [0.9, 0.8, 0.99], rtol=1e-5
    )


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"learning_rate": {"q": 0.1}}, "'q'; expected names of parameters: p"),
        ({"learning_rate": {}}, "no rate for p"),
        ({"learning_rate": {"p": -1}}, r"learning_rate\['p'\] is -1"),
        ({"learning_rate": {"p": 0.1}, "method": "lm"}, "has none; leave it out"),
        ({"learning_rate": 0.1, "method": "lm"}, "has none; leave it out"),
        ({"method": "lbfgs"}, "expected one of adam, sgd, lm, or an optimiser"),
        ({"method": object()}, "expected one of adam, sgd, lm, or a torch.optim"),
        ({"validate_every": 0}, "validate_every is 0"),
        ({"validation": 3}, "validation is 3"),
        ({"validation": Lines(), "method": "lm"}, "takes no validation"),
        ({"checkpoint": 5}, "checkpoint is 5"),
        ({"checkpoint": "/no/such/folder/fit.npz"}, "a folder that exists"),
        ({"checkpoint": "fit.npz", "checkpoint_every": 0}, "checkpoint_every is 0"),
    ],
)
def test_wrong_options(options, expected):
    pytest.importorskip("torch")
    with pytest.raises(RtsError, match=expected):
        rts.fit(Lines(), start(), **options)


def test_optimisers_that_do_not_fit_the_parameters():
    torch = pytest.importorskip("torch")
    p = start()
    with pytest.raises(InputError, match="other tensors"):
        rts.fit(Lines(), p, method=torch.optim.Adam([torch.zeros(3)]))
    with pytest.raises(InputError, match="LBFGS"):
        rts.fit(Lines(), p, method=torch.optim.LBFGS([p["p"]]))
    with pytest.raises(InputError, match="rates? .*own|has its own"):
        rts.fit(Lines(), p, method=torch.optim.Adam([p["p"]]), learning_rate=0.1)


# ------------------------------------------------------------------------------------------------- checkpoints


class Stop(Exception):
    """Ends a fit from its callback."""


def broken(at, path, **options):
    """A fit that ends by an error at a step, and then goes on from its checkpoint."""

    def report(step, parameters, loss):
        if step == at:
            raise Stop

    with pytest.raises(Stop):
        rts.fit(checkpoint=path, callback=report, **options)
    return rts.fit(checkpoint=path, **options)


@targets
@pytest.mark.parametrize("method", ["adam", "sgd", "lm"])
@pytest.mark.parametrize("at", [0, 6, 9, 19])
def test_a_fit_goes_on_bit_for_bit(tmp_path, target, method, at):
    options = {
        "residuals": Lines(batch=None if method == "lm" else 3, noise=1.0),
        "parameters": start(target),
        "method": method,
        "steps": 20,
        "tolerance": 0,
    }
    if method != "lm":
        options |= {"learning_rate": 0.1, "validate_every": 4}
    whole = rts.fit(**options)
    if at >= whole.steps:
        pytest.skip("it stops before")
    fit = broken(at, tmp_path / "fit.npz", checkpoint_every=3, **options)
    assert fit.history == whole.history and fit.validated == whole.validated and fit.reason == whole.reason
    assert fit.loss == whole.loss
    np.testing.assert_array_equal(to_numpy(fit.parameters)["p"], to_numpy(whole.parameters)["p"])
    assert [p.name for p in tmp_path.iterdir()] == ["fit.npz"]


def test_optimisers_go_on_with_their_moments(tmp_path):
    torch = pytest.importorskip("torch")
    p = start()
    options = {"residuals": Lines(batch=2), "parameters": p, "steps": 12}
    for method in (torch.optim.AdamW([p["p"]], lr=0.1), torch.optim.SGD([p["p"]], lr=0.05, momentum=0.9)):
        whole = rts.fit(method=method, **options)
        fit = broken(8, tmp_path / type(method).__name__, checkpoint_every=4, method=method, **options)
        assert fit.history == whole.history


def test_a_finished_fit_may_be_prolonged(tmp_path):
    options = {"residuals": Lines(batch=3), "parameters": start(), "learning_rate": 0.1, "patience": 1000}
    path = tmp_path / "fit.npz"
    short = rts.fit(steps=10, checkpoint=path, **options)
    again = rts.fit(steps=10, checkpoint=path, **options)
    assert again.history == short.history and again.loss == short.loss
    assert rts.fit(steps=25, checkpoint=path, **options).history == rts.fit(steps=25, **options).history


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    path = tmp_path / "fit.npz"
    rts.fit(Lines(), start(), steps=3, checkpoint=path)
    torch = pytest.importorskip("torch")
    with pytest.raises(InputError, match="another fit: its method is adam, and here lm"):
        rts.fit(Lines(), start(), method="lm", checkpoint=path)
    with pytest.raises(InputError, match="another fit: its parameters"):
        rts.fit(lambda p: p["p"], {"p": torch.zeros(4)}, checkpoint=path)
    for content in (b"", b"nonsense", path.read_bytes()[:-300]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is no checkpoint of rts.fit"):
            rts.fit(Lines(), start(), checkpoint=path)


def changed_archive(path, **changes):
    """Replace arrays of an archive."""
    with np.load(path) as file:
        known = {name: file[name] for name in file.files}
    np.savez(path, **{**known, **changes})
    path.with_name(f"{path.name}.npz").rename(path)
    return known


@pytest.mark.parametrize(
    "changes, expected",
    [
        (
            {"parameters.0": np.float32([0, np.nan, 0])},
            "its parameters.0 is missing, of another shape or dtype, or not",
        ),
        ({"best.0": np.zeros(4, np.float32)}, "its best.0 is missing, of another shape"),
        ({"best.0": np.zeros(3)}, "its best.0 is missing, of another shape or dtype"),
        ({"about": np.zeros(3, np.uint8)}, "its entry about is no JSON of a fit"),
        ({"method": np.frombuffer(pickle.dumps({}), np.uint8)}, "the state of its optimiser is damaged"),
    ],
)
def test_a_checkpoint_with_a_fault_is_refused_in_one_line(tmp_path, changes, expected):
    pytest.importorskip("torch")
    path = tmp_path / "fit"
    rts.fit(Lines(), start(), steps=3, checkpoint=path)
    changed_archive(path, **changes)
    with pytest.raises(InputError, match=expected) as caught:
        rts.fit(Lines(), start(), steps=9, checkpoint=path)
    shown = "".join(traceback.format_exception(caught.value))
    assert "weights_only" not in shown and "\n" not in str(caught.value)


def test_a_checkpoint_of_more_stages_is_refused(tmp_path):
    pytest.importorskip("torch")
    path = tmp_path / "fit"
    rts.fit(Lines(), start(), steps=3, checkpoint=path)
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
    about["stages"].append(about["run"])
    changed_archive(path, about=np.frombuffer(json.dumps(about).encode(), np.uint8))
    with pytest.raises(InputError, match="its stages are no list of the ends of fewer than 1"):
        rts.fit(Lines(), start(), checkpoint=path)


def test_the_state_of_an_optimiser_with_other_groups_is_refused(tmp_path):
    torch = pytest.importorskip("torch")
    p = start()
    path = tmp_path / "fit.npz"
    rts.fit(Lines(), p, method=torch.optim.Adam([p["p"]], lr=0.1), steps=3, checkpoint=path)
    with pytest.raises(InputError, match="of another optimiser"):
        rts.fit(Lines(), p, method=torch.optim.Adam([p["p"]], lr=0.1, amsgrad=True), steps=6, checkpoint=path)
    rts.fit(Lines(), p, method=torch.optim.Adam([p["p"]], lr=0.2), steps=6, checkpoint=path)


def test_a_fit_that_goes_astray_keeps_its_last_sound_state(tmp_path):
    torch = pytest.importorskip("torch")
    options = dict(learning_rate=1e38, method="sgd", steps=9, checkpoint_every=1)
    fit = rts.fit(Lines(), start(), checkpoint=tmp_path / "fit.npz", **options)
    assert "may have gone too far" in fit.reason
    again = rts.fit(Lines(), start(), checkpoint=tmp_path / "fit.npz", **options)
    assert (again.reason, again.history) == (fit.reason, fit.history)
    # A number that nobody reads may be NaN.
    unread = {"p": torch.zeros(3), "q": torch.tensor([float("nan")])}
    whole = rts.fit(Lines(), unread, steps=9)
    assert broken(6, tmp_path / "unread.npz", residuals=Lines(), parameters=unread, steps=9, checkpoint_every=3)
    assert whole.history == rts.fit(Lines(), unread, steps=9, checkpoint=tmp_path / "unread.npz").history


def test_a_checkpoint_that_cannot_be_read_is_one_line(tmp_path):
    for name, expected in (("a" * 300, "expected a file in a folder"), ("\0", "expected a file in a folder")):
        with pytest.raises(InputError, match=expected):
            rts.fit(Lines(), start(), checkpoint=tmp_path / name)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="cannot be read|expected a file in a folder"):
        rts.fit(Lines(), start(), checkpoint=tmp_path / "loop")


def test_a_full_disk_leaves_the_last_checkpoint_and_the_fit_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "fit.npz"
    rts.fit(Lines(), start(), steps=6, checkpoint=path, checkpoint_every=3)
    before = path.read_bytes()

    def full(file, **arrays):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints.np, "savez", full)
    with pytest.warns(RtsWarning, match="could not be written .No space left on device.; the fit goes on"):
        fit = rts.fit(Lines(), start(), steps=12, checkpoint=path, checkpoint_every=3)
    assert fit.steps == 12 and path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["fit.npz"]


def test_an_optimiser_of_optax_that_wants_the_loss_is_refused():
    optax, jnp = pytest.importorskip("optax"), pytest.importorskip("jax").numpy
    for method in (optax.lbfgs(), optax.polyak_sgd()):
        with pytest.raises(rts.InputError, match="needs more than the gradient .*'value'"):
            rts.fit(lambda x: x - 1, jnp.zeros(3), method=method, steps=2)
