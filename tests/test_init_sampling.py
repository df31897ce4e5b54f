"""Laws of RANSAC's samples: which subsets are drawn, and how many suffice."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from kornia_pnpnet.init.ransac.sampling import (
    Samples,
    agreement_of_neighbours,
    draw_likely,
    draw_subsets,
    samples_needed,
)


def uniform_numbers(count, size):
    return torch.rand(count, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("size", [3, 7])
def test_subsets_are_drawn_without_replacement(size):
    counts = torch.arange(size, 40)
    subsets = draw_subsets(uniform_numbers(500, size), counts)
    assert subsets.shape == (len(counts), 500, size)
    assert (subsets.diff(dim=-1) > 0).all()  # ascending: no item twice
    assert (subsets >= 0).all()
    assert (subsets < counts[:, None, None]).all()


@pytest.mark.parametrize(("count", "size"), [(6, 3), (9, 7), (5, 1)])
def test_every_subset_is_equally_likely(count, size):
    draws = 20000
    subsets = draw_subsets(uniform_numbers(draws, size), torch.tensor([count]))[0]
    _, seen = subsets.unique(dim=0, return_counts=True)
    expected = draws / math.comb(count, size)
    assert len(seen) == math.comb(count, size)
    chi_square = ((seen - expected) ** 2 / expected).sum()
    degrees = len(seen) - 1
    assert chi_square < degrees + 4.0 * math.sqrt(2.0 * degrees)


def test_likely_items_are_drawn_more_often_and_none_twice():
    """Items one after the other in proportion to their probabilities among those that are left."""
    draws, chances = 40000, torch.tensor([0.5, 0.2, 0.0, 0.2, 0.1], dtype=torch.float64)
    subsets = draw_likely(uniform_numbers(draws, 3), chances.cumsum(-1)[None])[0]
    for order in itertools.permutations((0, 1, 3, 4), 3):
        a, b, c = (chances[i].item() for i in order)
        expected = a * b / (1 - a) * c / (1 - a - b)
        seen = (subsets == torch.tensor(order)).all(-1).double().mean().item()
        assert abs(seen - expected) < 4 * math.sqrt(expected / draws), order
    assert (subsets != 2).all()
    assert (subsets.sort(-1).values.diff(dim=-1) > 0).all()


def surface(generator, count, wrong, *, size=6.0):
    """Points of a wavy surface and their pixels; those of the ``wrong`` last pairs are anywhere."""
    flat = size * torch.rand(2, count, 2, generator=generator, dtype=torch.float64)
    points = torch.cat((flat, 8.0 + flat.sin().sum(-1, keepdim=True)), -1)
    pixels = points[..., :2] / points[..., 2:]
    pixels[:, count - wrong :] = (
        torch.rand(2, wrong, 2, generator=generator, dtype=torch.float64) * pixels.amax(1)[:, None]
    )
    return points, pixels, torch.ones(2, count, dtype=torch.bool)


def test_neighbours_of_inliers_agree(generator):
    points, pixels, there = surface(generator, 200, 160)
    agreement = agreement_of_neighbours(points, pixels, there)
    likely = agreement.topk(20, dim=1).indices
    assert (likely < 40).double().mean() > 0.7  # 0.2 by chance


@pytest.mark.parametrize(("pairs", "size"), [(3, 3), (9, 7), (12, 4)])
def test_enumeration_has_every_subset_once(pairs, size):
    samples = Samples(torch.ones(2, pairs, dtype=torch.bool), size=size, most=1000, seed=0)
    total = math.comb(pairs, size)
    assert samples.totals.tolist() == [total, total]
    positions = samples.positions(torch.tensor([1, 0]), 0, total)
    assert sorted(map(tuple, positions[0].tolist())) == list(itertools.combinations(range(pairs), size))
    assert torch.equal(positions[0], positions[1])
    parts = [samples.positions(torch.tensor([1]), i, min(i + 5, total)) for i in range(0, total, 5)]
    assert torch.equal(torch.cat(parts, 1)[0], positions[0])


def test_only_pairs_with_a_weight_are_drawn_independent_of_other_problems(generator):
    there = torch.rand(20, 30, generator=generator) < torch.linspace(0.2, 0.8, 20)[:, None]
    there[:, :3] = True
    samples = Samples(there, size=3, most=200, seed=0)
    assert 0 < (samples.totals < 200).sum() < 20, "some are enumerated"
    problems = torch.arange(20)
    positions = samples.positions(problems, 0, 200)
    assert there[problems[:, None, None], positions].all()
    assert (positions.sort(-1).values.diff(dim=-1) > 0).all()
    for i in (0, 7, 19):
        alone = Samples(there[i : i + 1, : 1 + int(there[i].nonzero().max())], size=3, most=200, seed=0)
        alone = alone.positions(torch.tensor([0]), 10, 90)
        assert torch.equal(alone, samples.positions(torch.tensor([19, i]), 10, 90)[1:]), "nor of padding"


@pytest.mark.parametrize("size", [3, 7])
def test_the_number_of_samples_has_the_confidence(size):
    """By counting the subsets without an outlier."""
    count = 9
    for inliers, confidence in itertools.product(range(count + 1), (0.5, 0.9999)):
        subsets = list(itertools.combinations(range(count), size))
        share = sum(max(subset) < inliers for subset in subsets) / len(subsets)
        needed = samples_needed(torch.tensor([inliers]), torch.tensor([count]), size, confidence).item()
        if 0.0 < share < 1.0:
            assert 1.0 - (1.0 - share) ** needed == pytest.approx(confidence)
        else:
            assert needed == (0.0 if share else math.inf)
    assert samples_needed(torch.tensor([0]), torch.tensor([0]), size, 0.999).item() == math.inf
