# SPDX-License-Identifier: MIT
"""Data sets of samples made up, to be scored."""

from __future__ import annotations

import pytest

from tests.helpers import made


@pytest.fixture(scope="module", params=("laptop", "eyeglasses", "drawer"))
def split(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    return made.make_data(folder, request.param, count=11, train=30, points=48, background=4)


@pytest.fixture(scope="module")
def laptop(tmp_path_factory):
    return made.make_data(tmp_path_factory.mktemp("data"), "laptop", count=11, train=30, points=48)
