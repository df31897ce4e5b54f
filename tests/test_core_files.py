"""Digests of the contents, for any dtype, layout and order of keys, and files that are written in one piece."""

import hashlib
import json

import pytest
import torch

from kornia_pnpnet.core.files import digest, write_json


def test_digests_tell_contents_apart():
    x = torch.arange(6.0).reshape(2, 3)
    assert digest("a", b"b") == hashlib.sha256(b"ab").hexdigest()
    assert digest({"a": 1, "b": [2]}) == digest({"b": [2], "a": 1})
    assert digest(x.mT.contiguous().mT.requires_grad_()) == digest(x)
    others = (x.reshape(3, 2), x.double(), x.bfloat16(), x > 2, x + 1, x.int(), x.new_zeros(0), torch.tensor(1.0))
    assert len({digest(tensor) for tensor in (x, *others)}) == 1 + len(others)


@pytest.mark.parametrize(("content", "error"), [({"a": float("nan")}, ValueError), ([1, object()], TypeError)])
def test_content_that_json_does_not_have_leaves_the_old_file(tmp_path, content, error):
    path = tmp_path / "folder" / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(error):
        write_json(path, content)
    assert json.loads(path.read_text()) == {"a": 1}
    assert [*path.parent.iterdir()] == [path]
