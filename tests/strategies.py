"""What the fuzz tests draw: values of options, damaged files and results; and what numbers of every result are."""

import contextlib
import io
import json
import os

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError

from kornia_pnpnet.cli import main
from kornia_pnpnet.refine.kernels import KERNELS
from kornia_pnpnet.refine.lm import BACKWARDS

ERRORS = BaseError, ValueError
NAN, INF = float("nan"), float("inf")
TIMES = int(os.environ.get("PNPNET_EXAMPLES", "1"))


def many(examples):
    """Settings of a fuzz test; ``PNPNET_EXAMPLES`` multiplies its examples."""
    slow = [HealthCheck.too_slow]
    count = max(1, examples // 2 * TIMES)
    return settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=slow)


def finite(*values):
    for value in values:
        if isinstance(value, torch.Tensor):
            assert value.dtype == torch.bool or value.isfinite().all()
        elif value is not None:
            finite(*value)


def are_rotations(matrices):
    finite(matrices)
    flat = matrices.detach().double().reshape(-1, 3, 3)
    torch.testing.assert_close(flat @ flat.mT, torch.eye(3).double().expand_as(flat), rtol=0, atol=1e-4)


#: Numbers for options: sound ones, and those that make no sense.
ANY = st.one_of(st.floats(-2.0, 200.0), st.sampled_from([0, 1, -1, 0.0, 1e-6, 1e6, INF, -INF, NAN]))
COUNTS = st.one_of(st.integers(-2, 12), st.sampled_from([0.5, NAN, True]))
# Without a slash, which would make a word the name of a repository on the Hub.
TEXT = st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=12)
OPTIONS = ["fixed", "adaptive", "unknown", "always"]
OPTIONS += [*KERNELS, *BACKWARDS, "additive", "msac", "AP3P", "EPNP", "USAC_FAST", "epnp-lm", "pnpnet-n9"]
WORD = TEXT | st.sampled_from(OPTIONS)
ARGUMENTS = ["800,800,320,240", "epnp", "p3p-ransac:threshold=2", "pnpnet-set:m=", "epnp:1", "nan", "-1", "--x"]
WORDS = TEXT | st.sampled_from(ARGUMENTS)

#: What damage puts into a file.
TOKENS = (*b',|\n|\r|"|\0|\xff|nan|inf|-|1e999|;| |PK\x03\x04'.split(b"|"), b"9" * 400)


@st.composite
def damage(draw, content):
    """A file of which something was lost, changed or put in, up to four times."""
    content = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(content)))
        match draw(st.sampled_from(["cut", "lose", "change", "put in"])):
            case "cut":
                del content[place:]
            case "lose":
                del content[place : place + draw(st.integers(1, 40))]
            case "change":
                content[place : place + 1] = draw(st.binary(min_size=1, max_size=1))
            case "put in":
                content[place:place] = draw(st.sampled_from(TOKENS))
    return bytes(content)


def names_the_file(error, path):
    assert str(path) in str(error)


@st.composite
def spoiled(draw, content, places):
    """Results of which some values were lost or replaced."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 3))):
        *path, last = draw(st.sampled_from(places))
        inner = content
        with contextlib.suppress(KeyError, IndexError, TypeError):
            for key in path:
                inner = inner[key]
            if draw(st.booleans()):
                del inner[last]
            else:
                inner[last] = draw(st.sampled_from([None, "", "x", -1, 0, 1e300, [], {}, [None], True, {"a": 1}]))
    return content


def places_in(content, path=()):
    """All keys and indices of nested lists and dictionaries; of long lists the first two."""
    if isinstance(content, list):
        content = dict(enumerate(content[:2]))
    for key, value in content.items() if isinstance(content, dict) else ():
        yield (*path, key)
        yield from places_in(value, (*path, key))


def run_main(*arguments):
    """Exit code and what was printed. With the exit code 2 that is one line and no traceback."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(x) for x in arguments])
        except SystemExit as end:
            code = end.code
    assert code != 2 or (err.getvalue()[:8], err.getvalue().count("\n")) == ("pnpnet: ", 1), err.getvalue()
    return code, out.getvalue(), err.getvalue()
