"""Probabilities from raw scores: calibrated on fresh pairs, monotone, never certain, and worth something to RANSAC."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError, ShapeError, TypeCheckError, ValueCheckError
from strategies import many
from torch import nn

from kornia_pnpnet import Calibration, create_solver, fit_confidence, pose_errors, success
from kornia_pnpnet.data import OutlierMix, SyntheticProblems

METHODS = ("isotonic", "logistic")


def draw(law, count, generator):
    scores = torch.randn(count, generator=generator, dtype=torch.float64)
    return scores, torch.rand(count, generator=generator, dtype=torch.float64) < law(scores)


def logistic(scores):
    return torch.sigmoid(1.5 * scores - 1.0)


def saturating(scores):
    """Not logistic: pairs with the best scores are wrong in a third of all cases."""
    return 0.05 + 0.6 * torch.sigmoid(4.0 * scores)


# --- probabilities ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "law"),
    [("isotonic", logistic), ("isotonic", saturating), ("logistic", logistic)],
    ids=["isotonic", "isotonic-saturating", "logistic"],
)
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["higher", "lower"])
def test_probabilities_are_those_of_fresh_pairs(method, law, sign, generator):
    scores, inliers = draw(law, 50_000, generator)
    calibration = fit_confidence(sign * scores, inliers, method)
    scores, inliers = draw(law, 50_000, generator)
    found = calibration(sign * scores)
    assert (found - law(scores)).abs().mean() < 0.015
    for part in found.argsort().chunk(10):
        share, count = found[part].mean(), len(part)
        sigma = (share * (1.0 - share) / count).sqrt()
        assert (inliers[part].double().mean() - share).abs() < 5.0 * sigma, share


def test_a_logistic_law_is_found(generator):
    scores, inliers = draw(logistic, 20_000, generator)
    calibration = fit_confidence(scores, inliers, "logistic")
    slope = calibration.logits.diff() / calibration.scores.diff()
    offset = calibration.logits[0] - slope * calibration.scores[0]
    # About four standard errors of a fit to so many scores, by the Fisher information of this law.
    assert slope.item() == pytest.approx(1.5, abs=0.1)
    assert offset.item() == pytest.approx(-1.0, abs=0.08)


def levels_by_definition(scores, inliers):
    """Isotonic regression as max over j <= i of min over k >= i of the mean of j to k, with the added halves."""
    values = scores.unique()
    right = torch.stack([(inliers & (scores == v)).sum() for v in values]).double()
    count = torch.stack([(scores == v).sum() for v in values]).double()
    for end in (0, -1):
        right[end] += 0.5
        count[end] += 1.0
    size = range(len(values))
    means = [[right[j : k + 1].sum() / count[j : k + 1].sum() for k in size] for j in size]
    return torch.tensor([max(min(means[j][k] for k in size[i:]) for j in size[: i + 1]) for i in size]).double()


@pytest.mark.parametrize("seed", range(30))
def test_isotonic_is_the_regression_by_definition(seed):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.randint(0, 12, (25,), generator=generator).double()
    higher = scores if seed % 2 else 11.0 - scores
    inliers = torch.rand(25, generator=generator) < (higher + 6.0) / 24.0
    sign = 1.0 if (scores[inliers][:, None] - scores[~inliers]).sign().sum() >= 0 else -1.0
    rising = sign * scores
    expected, counts = levels_by_definition(rising, inliers).unique_consecutive(return_counts=True)
    blocks = rising.unique().split(counts.tolist())
    middles = torch.stack([rising[torch.isin(rising, block)].quantile(0.5) for block in blocks])

    calibration = fit_confidence(scores, inliers)
    torch.testing.assert_close(calibration(sign * middles), expected)
    assert len(calibration.scores) == len(expected)


TAILS = torch.distributions.Cauchy(0.0, 1.0).icdf(torch.linspace(0.001, 0.999, 200).double())
STEP = torch.arange(200) >= 120


@pytest.mark.parametrize(
    ("scores", "inliers"),
    [
        (torch.linspace(-1.0, 1.0, 200).double(), STEP),
        (torch.linspace(-1.0, 1.0, 200).double(), (torch.arange(200) * 7) % 5 > 2),
        (1e6 + 1e-3 * torch.arange(200).double(), ~STEP),
        (TAILS, STEP ^ (torch.arange(200) % 9 == 0)),
        (1e6 * TAILS, STEP),
        (torch.tensor([3.0, 4.0]).double(), torch.tensor([True, False])),
        (torch.arange(4000).clamp(max=1).double(), torch.arange(4000) == 0),  # full steps of Newton's method diverge
    ],
    ids=["separable", "chance", "offset", "tails", "separable-tails", "two", "unbalanced"],
)
def test_logistic_is_at_the_minimum_of_its_cost(scores, inliers):
    """Cross-entropy to Platt's targets, differentiated by autograd."""
    calibration = fit_confidence(scores, inliers, "logistic")
    slope = calibration.logits.diff() / calibration.scores.diff()
    unit = (scores - scores.mean()) / scores.std()
    law = torch.cat((slope * scores.std(), calibration.logits[:1] + slope * (scores.mean() - calibration.scores[:1])))
    law.requires_grad_()
    count = inliers.sum()
    target = torch.where(inliers, (count + 1) / (count + 2), 1 / (len(inliers) - count + 2)).double()
    logits = law[0] * unit + law[1]
    nn.functional.binary_cross_entropy_with_logits(logits, target).backward()
    assert law.grad.abs().max() < 1e-6


def test_a_score_far_off_costs_no_digits(generator):
    """In float32 the distance of the other scores from this one has no digits after the point."""
    scores, inliers = draw(logistic, 2000, generator)
    scores, inliers = torch.cat((scores, torch.tensor([-1e5]))), torch.cat((inliers, torch.tensor([False])))
    double, single = (fit_confidence(x, inliers, "logistic") for x in (scores, scores.float()))
    torch.testing.assert_close(single(scores.float()), double(scores).float(), rtol=1e-3, atol=1e-6)


# --- never certain ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 50])
def test_few_pairs_are_not_certain(count):
    """Of Jeffreys's prior: (k + 1/2) / (n + 1) at both ends."""
    scores = torch.arange(2 * count).double()
    calibration = fit_confidence(scores, scores >= count)
    expected = 0.5 / (count + 1)
    torch.testing.assert_close(calibration(scores[[0, -1]]), torch.tensor([expected, 1.0 - expected]).double())


@pytest.mark.parametrize("method", METHODS)
def test_one_score_for_all_tells_the_share_of_the_inliers(method):
    inliers = torch.arange(1000) < 300
    calibration = fit_confidence(torch.full((1000,), 0.7), inliers, method)
    found = calibration(torch.tensor([-1e30, 0.7, 5.0, math.inf]))
    assert (found - 0.3).abs().max() < 2e-3
    assert found.unique().numel() == 1


@many(200)
@given(
    st.lists(st.tuples(st.integers(-5, 5) | st.floats(-1e18, 1e18), st.booleans()), min_size=2, max_size=40),
    st.sampled_from(METHODS),
    st.sampled_from([torch.float64, torch.float32, torch.bfloat16]),
)
def test_any_pairs_give_a_monotone_map_into_the_open_interval(pairs, method, dtype):
    scores = torch.tensor([float(score) for score, _ in pairs], dtype=dtype).clamp(-9e17, 9e17)
    inliers = torch.tensor([inlier for _, inlier in pairs])
    if inliers.all() or not inliers.any():
        return
    calibration = fit_confidence(scores, inliers, method)
    ends = torch.tensor([-math.inf, -1e18, 0.0, 1e18, math.inf], dtype=dtype)
    at = torch.cat((scores, ends, torch.linspace(-6.0, 6.0, 50, dtype=dtype))).sort().values
    found = calibration(at)
    assert found.dtype == dtype
    assert ((found > 0.0) & (found < 1.0)).all()
    # Rounding of an interpolation may turn its last digits around.
    steps, slack = found.double().diff(), 4.0 * torch.finfo(torch.promote_types(dtype, torch.float32)).eps
    assert (steps >= -slack).all() or (steps <= slack).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64], ids=str)
def test_every_dtype_stays_and_stays_uncertain(method, dtype):
    """A million pairs that scores separate: the nearest number of half precision would be 0 or 1."""
    scores = torch.arange(-50, 50).repeat(10_000)
    calibration = fit_confidence(scores, scores >= 0, method)
    found = calibration(scores[:100].to(dtype))
    assert found.dtype == (dtype if dtype.is_floating_point else torch.float32)
    assert ((found > 0.0) & (found < 1.0)).all()
    assert (found[:40] < 0.02).all()
    assert (found[60:] > 0.98).all()


# --- pairs that do not count --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_unknown_scores_and_padding_are_left_out(method, generator):
    scores, inliers = draw(logistic, 400, generator)
    unknown, padding = torch.arange(400) % 7 == 0, torch.arange(400) % 5 == 0
    expected = fit_confidence(scores[~unknown & ~padding], inliers[~unknown & ~padding], method)
    given = torch.where(padding, math.inf, torch.where(unknown, math.nan, scores)).reshape(2, 4, 50)
    found = fit_confidence(given, inliers.reshape(2, 4, 50), method, mask=~padding.reshape(2, 4, 50))
    assert torch.equal(found.scores, expected.scores)
    assert torch.equal(found.logits, expected.logits)
    probabilities = found(given)
    assert probabilities.shape == given.shape
    assert torch.equal(probabilities.isnan().flatten(), unknown & ~padding)


@pytest.mark.parametrize("method", METHODS)
def test_gradients(method, generator):
    scores, inliers = draw(logistic, 500, generator)
    calibration = fit_confidence(scores, inliers, method)
    inside = (calibration.scores[:-1] + calibration.scores[1:]) / 2.0
    assert torch.autograd.gradcheck(calibration, inside.requires_grad_())
    low, high = calibration.scores[[0, -1]]
    at = torch.stack((low - 1.0, inside.detach()[0], torch.tensor(math.nan), high + 1.0, torch.tensor(-math.inf)))
    at = at.requires_grad_()
    calibration(at).nansum().backward()
    assert at.grad.isfinite().all()
    assert (at.grad != 0.0).tolist() == [False, True, False, False, False]


# --- as a module --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_state_goes_into_a_new_module(method, generator, tmp_path):
    scores, inliers = draw(logistic, 500, generator)
    fitted = nn.Sequential(nn.Identity(), fit_confidence(scores.float(), inliers, method))
    torch.save(fitted.state_dict(), tmp_path / "state.pt")
    loaded = nn.Sequential(nn.Identity(), Calibration())
    assert torch.equal(loaded(scores), torch.full_like(scores, 0.5))
    loaded.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(loaded(scores), fitted(scores))


def test_a_damaged_state_is_refused():
    table = Calibration([0.0, 1.0], [0.1, 0.9]).state_dict()
    with pytest.raises(RuntimeError, match="size mismatch"):
        Calibration().load_state_dict({**table, "logits": torch.zeros(3)})
    with pytest.raises(RuntimeError, match="Missing"):
        Calibration().load_state_dict({"scores": table["scores"]})


def test_a_module_in_half_precision_still_works(generator):
    """The table then has scores that are equal."""
    scores, inliers = draw(logistic, 5000, generator)
    fitted = fit_confidence(scores + 100.0, inliers)
    expected, found = fitted(scores + 100.0), fitted.half()(scores + 100.0)
    assert (found - expected).abs().max() < 0.1
    assert (found[scores.argsort()].diff() >= 0).all()


# --- arguments ----------------------------------------------------------------------------------------------------


def test_arguments_are_checked():
    scores, inliers = torch.linspace(0.0, 1.0, 6), torch.tensor([0, 0, 1, 0, 1, 1]).bool()
    for error, match, arguments, options in (
        (BaseError, "method", (scores, inliers, "linear"), {}),
        (ShapeError, "inliers", (scores, inliers[:5]), {}),
        (ShapeError, "inliers", (scores[:, None], inliers), {}),
        (ShapeError, "mask", (scores, inliers), {"mask": inliers[None]}),
        (TypeCheckError, "inliers", (scores, inliers.float()), {}),
        (TypeCheckError, "mask", (scores, inliers), {"mask": inliers.float()}),
        (TypeCheckError, "scores", (scores.tolist(), inliers), {}),
        (TypeCheckError, "scores", (inliers, inliers), {}),
        (ValueCheckError, "0 inliers and 0 outliers", (scores[:0], inliers[:0]), {}),
        (ValueCheckError, "6 inliers and 0 outliers", (scores, inliers | True), {}),
        (ValueCheckError, "0 inliers and 3 outliers", (scores, inliers), {"mask": ~inliers}),
        (ValueCheckError, "0 inliers and 3 outliers", (scores.where(~inliers, math.nan), inliers), {}),
        (ValueCheckError, "1e.18", (scores.where(scores > 0, -math.inf), inliers), {}),
    ):
        with pytest.raises(error, match=match):
            fit_confidence(*arguments, **options)
    with pytest.raises(TypeCheckError, match="scores"):
        fit_confidence(scores, inliers)(inliers)


@pytest.mark.parametrize(
    ("scores", "probabilities"),
    [
        ([], []),
        ([0.0, 0.0], [0.1, 0.9]),
        ([1.0, 0.0], [0.1, 0.9]),
        ([0.0, math.inf], [0.1, 0.9]),
        ([0.0, 1.0], [0.1, 1.0]),
        ([0.0, 1.0], [math.nan, 0.5]),
        ([0.0, 1.0, 2.0], [0.1, 0.9, 0.5]),
        ([0.0, 1.0], [0.1]),
        ([[0.0, 1.0]], [[0.1, 0.9]]),
    ],
)
def test_a_table_that_is_no_map_is_refused(scores, probabilities):
    with pytest.raises((ValueCheckError, ShapeError)):
        Calibration(scores, probabilities)


# --- what for -----------------------------------------------------------------------------------------------------


def ratios(inliers, generator):
    """Ratios of the distances to the nearest and the second nearest descriptor: lower is better."""
    uniform = torch.rand(inliers.shape, generator=generator)
    return torch.where(inliers, 0.45 + 0.55 * uniform, 1.0 - 0.4 * uniform**2)


def test_fitted_confidences_find_poses_among_many_outliers(generator):
    known, problems = (
        SyntheticProblems(n=100, batch_size=60, seed=seed, world_sigma=0.0, outliers=OutlierMix(count=88)).batch(0)
        for seed in (1, 2)
    )
    fitted = ratios(known.inliers, generator), known.inliers
    scores = ratios(problems.inliers, generator)
    confidences = {"none": None, "raw": 1.0 - scores}
    confidences |= {method: fit_confidence(*fitted, method)(scores) for method in METHODS}
    solver = create_solver("p3p-ransac", max_samples=300)
    rates = {}
    with torch.no_grad():
        for name, confidence in confidences.items():
            errors = pose_errors(solver(*problems[:3], confidence=confidence).pose, problems.pose)
            rates[name] = success(errors, max_translation=0.5).double().mean().item()
    assert min(rates["isotonic"], rates["logistic"]) > rates["none"] + 0.15, rates
    assert rates["isotonic"] > rates["raw"] + 0.05, rates


# --- noise --------------------------------------------------------------------------------------------------------


def keypoints(power, generator, batch=500, n=11):
    """Keypoints as a network finds them: less accurate (``power``) and more often wrong where it is less confident."""
    problems = SyntheticProblems(n=n, batch_size=batch, seed=31, img_sigma=0.0, world_sigma=0.0).batch(0)
    confidence = torch.rand(batch, n, generator=generator) ** 0.4
    sigma = confidence.clamp(min=0.05) ** -power
    pixels = problems.img_points + sigma[..., None] * torch.randn(batch, n, 2, generator=generator)
    elsewhere = pixels.roll(1, 1) + 50.0 * torch.randn(batch, n, 2, generator=generator)
    inliers = torch.rand(batch, n, generator=generator) < 0.98 * confidence.sqrt()
    return problems._replace(img_points=torch.where(inliers[..., None], pixels, elsewhere), inliers=inliers), confidence


@pytest.mark.parametrize("power", [0.0, 1.5, 3.0])
def test_confidence_is_at_least_as_good_as_weights_made_of_it(power, generator):
    problems, confidence = keypoints(power, generator)
    solver, given = create_solver("pnpnet-set"), problems[:3]
    options = {"confidence": {"confidence": confidence}, "weights": {"weights": confidence**6}, "nothing": {}}
    errors = {}
    with torch.no_grad():
        for name, option in options.items():
            rotation, _ = pose_errors(solver(*given, **option).pose, problems.pose)
            errors[name] = rotation.clamp(max=10.0).mean()
    assert errors["confidence"] < errors["weights"]
    assert errors["confidence"] < (0.75 if power == 3.0 else 1.02) * errors["nothing"]
