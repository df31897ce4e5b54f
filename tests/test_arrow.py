"""Tables of problems: the poses are those of a call, and no row stops or changes another one."""

import pickle

import numpy as np
import pytest
import torch
from data_helpers import table as table_of
from kornia.core.exceptions import ShapeError, TypeCheckError, ValueCheckError

from kornia_pnpnet import create_solver

pa = pytest.importorskip("pyarrow")
from kornia_pnpnet.arrow import OUTPUTS, Solve  # noqa: E402

NAMES = ("world_points", "img_points", "intrinsics")


@pytest.fixture
def draw(make_problems):
    """Draw problems, and their table with more columns."""

    def make(n=9, batch=7, seed=0, **more):
        problems = make_problems(n=n, batch=batch, seed=seed, dtype=torch.float32)
        return problems, table_of(problems, **more)

    return make


def numbers(table, name):
    """A column of lists of the same length as an array."""
    return np.array(table[name].to_pylist())


@pytest.mark.parametrize("name", ["epnp-lm", "p3p-ransac", "pnpnet-n9", "pnpnet-set", "poselib"])
def test_poses_are_those_of_a_call(name, draw):
    if name == "poselib":
        pytest.importorskip("poselib")
    problems, table = draw()
    expected = create_solver(name)(*problems[:3])
    found = Solve(name)(table)
    assert found["ok"].to_pylist() == expected.ok.tolist()
    for key in ("rotation", "translation", "weights", "cost"):
        np.testing.assert_array_equal(numbers(found, key).ravel(), getattr(expected, key).numpy().ravel())


def test_weights_sigmas_and_options_reach_the_solver(draw):
    weights, img_sigma = np.ones((7, 9), np.float32), np.linspace(0.5, 2.0, 63, dtype=np.float32).reshape(7, 9)
    weights[:, 7:] = 0.0
    world_sigma = np.full((7, 1), 0.05, np.float32)
    problems, table = draw(weights=weights, img_sigma=img_sigma, world_sigma=world_sigma)
    tensors = {"weights": weights, "img_sigma": img_sigma, "world_sigma": world_sigma.repeat(9, 1)}
    expected = create_solver("pnpnet-set", m=3)(*problems[:3], **{k: torch.from_numpy(x) for k, x in tensors.items()})
    as_number = table.set_column(5, "world_sigma", pa.array(world_sigma[:, 0]))
    for given in (table, as_number):
        np.testing.assert_array_equal(numbers(Solve("pnpnet-set", m=3)(given), "translation"), expected.translation)


def test_a_camera_for_all(draw):
    problems, table = draw()
    camera = problems.intrinsics[0]
    assert Solve("epnp-lm", intrinsics=camera)(table.drop_columns("intrinsics")) == Solve("epnp-lm")(table)
    with pytest.raises(ShapeError):
        Solve("epnp-lm", intrinsics=camera[:2])


@pytest.mark.parametrize("name", ["epnp-lm", "pnpnet-set"])
def test_rows_of_different_numbers_of_pairs(name, draw):
    sizes = [6, 40, 9, 17, 9, 33, 16]
    drawn = [draw(n, 1, seed) for seed, n in enumerate(sizes)]
    solve = Solve(name)
    found = solve(pa.concat_tables(table for _, table in drawn))
    assert [len(x) for x in found["weights"].to_pylist()] == sizes
    for row, (problems, table) in zip(found.to_pylist(), drawn, strict=True):
        alone = solve.solver(*problems[:3])
        np.testing.assert_allclose(row["translation"], alone.translation[0], rtol=1e-3)
        np.testing.assert_allclose(row["weights"], alone.weights[0], rtol=1e-2, atol=1e-4)
        assert row["ok"] == alone.ok.item()
        np.testing.assert_allclose(row["rotation"], numbers(solve(table), "rotation")[0], atol=1e-5)


def test_other_columns_pass_through_and_rows_keep_their_order(draw):
    _, table = draw(batch=5)
    table = table.append_column("id", pa.array([3, 1, 4, 1, 5])).append_column("name", pa.array([*"abcde"]))
    found = Solve("epnp-lm")(table)
    assert found.column_names == ["id", "name", *OUTPUTS]
    assert found["id"].to_pylist() == [3, 1, 4, 1, 5]
    backwards = Solve("epnp-lm")(table.take([4, 3, 2, 1, 0]))
    np.testing.assert_allclose(numbers(backwards, "rotation")[::-1], numbers(found, "rotation"), atol=1e-5)


BAD = {
    "a missing list": ("world_points", None, "malformed"),
    "an empty list": ("img_points", [], "malformed"),
    "too few pixels": ("img_points", [1.0] * 17, "malformed"),
    "too many points": ("world_points", [1.0] * 30, "malformed"),
    "part of a point": ("world_points", [1.0] * 28, "malformed"),
    "two pairs": ("world_points", [1.0] * 6, "malformed"),
    "no camera": ("intrinsics", [0.0] * 9, "camera"),
    "half a camera": ("intrinsics", [1.0] * 4, "malformed"),
    "NaN": ("img_points", [float("nan")] * 18, "not_finite"),
    "a missing number": ("world_points", [None, *[1.0] * 26], "not_finite"),
    "one point": ("world_points", [1.0] * 27, "degenerate"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_row_is_not_ok_and_changes_no_other(kind, draw):
    name, cell, status = BAD[kind]
    _, table = draw()
    good = Solve("epnp-lm")(table)
    cells = table[name].to_pylist()
    cells[2] = cell
    found = Solve("epnp-lm")(table.set_column(NAMES.index(name), name, pa.array(cells)))
    row = found.to_pylist()[2]
    assert (row["ok"], row["status"]) == (False, status)
    assert row["rotation"] == np.eye(3).ravel().tolist()
    assert np.isfinite([*row["translation"], *row["weights"], row["cost"]]).all()
    others = [0, 1, 3, 4, 5, 6]
    assert found.take(others)["ok"] == good.take(others)["ok"]
    np.testing.assert_allclose(numbers(found, "rotation")[others], numbers(good, "rotation")[others], atol=1e-5)


def test_rows_for_another_network_are_malformed_and_few_rows_are_a_table(draw):
    table = pa.concat_tables([draw(8, 2)[1], draw(9, 3)[1]])
    solve = Solve("pnpnet-n9")
    assert solve(table)["status"].to_pylist() == ["malformed"] * 2 + ["solved"] * 3
    assert [len(solve(table.slice(2, rows))) for rows in (0, 1)] == [0, 1]


def test_any_kind_of_list(draw):
    """Slices, large, fixed-size and nested lists, other dtypes."""
    _, table = draw()
    expected = numbers(Solve("epnp-lm")(table.slice(2, 3)), "translation")
    for make in (
        lambda x: x.cast(pa.large_list(pa.float64())),
        lambda x: x.cast(pa.list_(pa.float64(), len(x[0]))),
        lambda x: pa.array([np.reshape(y, (-1, 1)).tolist() for y in x.to_pylist()]),
        lambda x: pa.chunked_array([x.combine_chunks()[:3], x.combine_chunks()[3:]]),
    ):
        other = pa.table({name: make(table[name]) for name in NAMES})
        np.testing.assert_allclose(numbers(Solve("epnp-lm")(other.slice(2, 3)), "translation"), expected, rtol=1e-4)


def test_tables_that_are_not_of_problems(draw):
    _, table = draw()
    for wrong, error in (
        (table.drop_columns("img_points"), ValueCheckError),
        (table.drop_columns("intrinsics"), ValueCheckError),
        (table.set_column(0, "world_points", pa.array(["x"] * 7)), TypeCheckError),
        (table.set_column(0, "world_points", pa.array([["x"]] * 7)), TypeCheckError),
    ):
        with pytest.raises(error):
            Solve("epnp-lm")(wrong)


def test_a_worker_gets_it_pickled(draw):
    _, table = draw()
    for solve in (Solve("pnpnet-n9"), Solve(create_solver("pnpnet-set").eval())):
        assert pickle.loads(pickle.dumps(solve))(table) == solve(table)


def test_no_call_of_the_solver_is_large(draw, monkeypatch):
    _, table = draw(batch=50)
    solve = Solve("epnp-lm")
    expected, called, forward = solve(table), [], solve.solver.forward

    def counting(**inputs):
        called.append(inputs["world_points"].shape[:2].numel())
        return forward(**inputs)

    monkeypatch.setattr(solve.solver, "forward", counting)
    solve.pairs_at_once = 100
    np.testing.assert_allclose(numbers(solve(table), "rotation"), numbers(expected, "rotation"), atol=1e-5)
    assert sum(called) == 450
    assert max(called) <= 100
