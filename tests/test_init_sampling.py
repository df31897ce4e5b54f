"""Laws of RANSAC's counting: subsets, when to stop, and what could be chance."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from kornia_pnpnet.init.ransac.sampling import (
    Samples,
    draw_subsets,
    good_sample_share,
    samples_needed,
)
from kornia_pnpnet.refine.verdict import log_false_alarms


def uniform_numbers(count, size, seed=0):
    return torch.rand(count, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# --- subsets ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [3, 4, 7])
def test_subsets_are_drawn_without_replacement(size):
    counts = torch.arange(size, 40)
    subsets = draw_subsets(uniform_numbers(500, size), counts)
    assert subsets.shape == (len(counts), 500, size)
    assert (subsets.diff(dim=-1) > 0).all()  # ascending: no item twice
    assert (subsets >= 0).all()
    assert (subsets < counts[:, None, None]).all()


@pytest.mark.parametrize(("count", "size"), [(6, 3), (9, 7), (5, 1)])
def test_every_subset_is_as_likely(count, size):
    draws = 20000
    subsets = draw_subsets(uniform_numbers(draws, size), torch.tensor([count]))[0]
    _, seen = subsets.unique(dim=0, return_counts=True)
    expected = draws / math.comb(count, size)
    assert len(seen) == math.comb(count, size)
    chi_square = ((seen - expected) ** 2 / expected).sum()
    degrees = len(seen) - 1
    assert chi_square < degrees + 4.0 * math.sqrt(2.0 * degrees)


def test_the_ends_of_the_unit_interval_stay_inside():
    ends = torch.tensor([[0.0] * 3, [1.0 - 2.0**-53] * 3], dtype=torch.float64)
    assert draw_subsets(ends, torch.tensor([2**30])).tolist() == [[[0, 1, 2], [2**30 - 3, 2**30 - 2, 2**30 - 1]]]


@pytest.mark.parametrize(("pairs", "size"), [(3, 3), (9, 3), (9, 7), (12, 4)])
def test_enumeration_has_every_subset_once(pairs, size):
    samples = Samples(torch.ones(2, pairs, dtype=torch.bool), size=size, most=1000, seed=0)
    assert samples.enumerated
    positions = samples.positions(torch.tensor([1, 0]), 0, samples.total)
    expected = list(itertools.combinations(range(pairs), size))
    assert sorted(map(tuple, positions[0].tolist())) == expected
    assert torch.equal(positions[0], positions[1])
    parts = [samples.positions(torch.tensor([1]), i, min(i + 5, samples.total)) for i in range(0, samples.total, 5)]
    assert torch.equal(torch.cat(parts, 1)[0], positions[0])


def test_the_seed_fixes_the_order_of_enumeration():
    def order(seed):
        samples = Samples(torch.ones(1, 9, dtype=torch.bool), size=3, most=100, seed=seed)
        return samples.positions(torch.tensor([0]), 0, 84)

    assert torch.equal(order(0), order(0))
    assert not torch.equal(order(0), order(1))
    assert order(0)[0].tolist() != sorted(order(0)[0].tolist())  # no prefix is a corner of the image


def test_only_pairs_that_are_there_are_drawn(generator):
    there = torch.rand(20, 30, generator=generator) < 0.5
    there[:, :3] = True
    samples = Samples(there, size=3, most=200, seed=0)
    assert not samples.enumerated
    problems = torch.arange(20)
    positions = samples.positions(problems, 0, 200)
    assert there[problems[:, None, None], positions].all()
    assert (positions.sort(-1).values.diff(dim=-1) > 0).all()


def test_a_problem_draws_the_same_whatever_the_others_are(generator):
    there = torch.rand(20, 30, generator=generator) < 0.7
    together = Samples(there, size=3, most=100, seed=0)
    for i in (0, 7, 19):
        alone = Samples(there[i : i + 1], size=3, most=100, seed=0)
        assert torch.equal(
            alone.positions(torch.tensor([0]), 10, 90), together.positions(torch.tensor([19, i]), 10, 90)[1:]
        )


@pytest.mark.parametrize("there", [0, 1, 2])
@pytest.mark.parametrize("size", [3, 7])
def test_too_few_pairs_still_give_positions(there, size):
    mask = torch.zeros(1, 20, dtype=torch.bool)
    mask[0, 5 : 5 + there] = True
    positions = Samples(mask, size=size, most=50, seed=0).positions(torch.tensor([0]), 0, 50)
    assert ((positions >= 0) & (positions < 20)).all()


def test_spread_covers_the_pairs_that_are_there(generator):
    there = torch.rand(10, 100, generator=generator) < 0.6
    samples = Samples(there, size=3, most=10, seed=0)
    positions = samples.spread(torch.arange(10), 16)
    assert there[torch.arange(10)[:, None], positions].all()
    ranks = (there.cumsum(-1) - 1).gather(1, positions)
    gaps = ranks.diff(dim=-1)
    even = there.sum(-1, keepdim=True) / 16
    assert ((gaps >= even.floor()) & (gaps <= even.ceil())).all()


# --- when to stop -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [3, 7])
def test_share_of_good_samples_by_counting(size):
    count = 9
    for inliers in range(count + 1):
        subsets = list(itertools.combinations(range(count), size))
        good = sum(max(subset) < inliers for subset in subsets)
        share = good_sample_share(torch.tensor([inliers]), torch.tensor([count]), size)
        assert share.item() == pytest.approx(good / len(subsets))
        assert share.item() <= (inliers / count) ** size + 1e-12


def test_so_many_samples_have_the_confidence():
    inliers, counts = torch.tensor([30, 50, 80, 99]), torch.full((4,), 100)
    share = good_sample_share(inliers, counts, 3)
    for confidence in (0.5, 0.99, 0.9999):
        needed = samples_needed(inliers, counts, 3, confidence)
        torch.testing.assert_close(1.0 - (1.0 - share) ** needed, torch.full_like(share, confidence))


def test_no_outlier_needs_no_further_sample_and_no_inlier_never_stops():
    assert samples_needed(torch.tensor([5]), torch.tensor([5]), 3, 0.999).item() == 0.0
    assert samples_needed(torch.tensor([2, 0]), torch.tensor([5, 0]), 3, 0.999).tolist() == [math.inf, math.inf]


# --- what could be chance ---------------------------------------------------------------------------------------------


def test_false_alarms_by_counting():
    for tested, inliers, count, chance in ((10, 5, 9, 0.01), (1, 4, 4, 0.3), (500, 30, 100, 0.001), (7, 3, 8, 0.5)):
        expected = tested * math.comb(count - 3, inliers - 3) * chance ** (inliers - 3)
        log = log_false_alarms(*(torch.tensor([x]) for x in (tested, inliers, count)), torch.tensor([chance]))
        assert log.item() == pytest.approx(math.log(expected), abs=1e-5)


def test_false_alarms_are_finite_at_the_limits():
    zero, one = torch.zeros(1, dtype=torch.long), torch.ones(1)
    for inliers, count in ((0, 0), (2, 2), (3, 3), (9, 9)):
        for chance in (0.0 * one, one):
            log = log_false_alarms(zero, zero + inliers, zero + count, chance)
            assert log.isfinite().all()
