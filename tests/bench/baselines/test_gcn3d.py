# SPDX-License-Identifier: MIT
"""3D-GCN's layers against plain loops, its sizes, and what its kernels cannot see."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from bench.baselines import gcn3d
from bench.baselines.gcn3d import (
    Convolution,
    Gcn3dBody,
    Gcn3dConfig,
    Graph,
    GreatestResponse,
    Surface,
    graph,
    pooled,
)
from scapo.first_weights import initialise
from tests.helpers.strategies import generator, normal, rotations


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(("support", "published"), [(1, 1.69e6), (7, 3.19e6)])
def test_the_body_has_the_published_size(support: int, published: float) -> None:
    assert parameters(Gcn3dBody(Gcn3dConfig(support=support))) == pytest.approx(published, rel=0.05)
    assert parameters(Gcn3dBody(gcn3d.cpu_config())) < 0.2e6


@pytest.mark.parametrize("featureless", [True, False])
def test_the_greatest_response_against_loops_and_differences(
    featureless: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gcn3d, "ROWS", 4)  # several blocks
    directions = F.normalize(normal(0, 6, 3, 3), dim=-1)
    kernels = normal(1, 3, 5).requires_grad_()
    features = None if featureless else normal(2, 6, 5).requires_grad_()
    index = torch.randint(6, (6, 3), generator=generator(3))
    found = GreatestResponse.apply(directions, kernels, features, index)
    for m in range(6):
        for c in range(5):
            values = []
            for k in range(3):
                cosine = max(0.0, (directions[m, k] @ kernels[:, c]).item())
                weight = 1.0 if features is None else features[index[m, k], c].item()
                values.append(cosine * weight)
            assert found[m, c].item() == pytest.approx(max(values))
    free = (kernels,) if features is None else (kernels, features)
    assert torch.autograd.gradcheck(
        lambda k, f=None: GreatestResponse.apply(directions, k, f, index), free
    )


def test_the_greatest_response_of_more_neighbours_than_a_byte_counts() -> None:
    directions = F.normalize(normal(0, 4, 300, 3), dim=-1)
    kernels, features = normal(1, 3, 5).requires_grad_(), normal(2, 4, 5).requires_grad_()
    index = torch.randint(4, (4, 300), generator=generator(3))
    plain = ((directions @ kernels).relu() * features[index]).amax(1)
    found = GreatestResponse.apply(directions, kernels, features, index)
    assert_close(found, plain)
    wanted = torch.autograd.grad(plain.sum(), (kernels, features))
    assert_close(torch.autograd.grad(found.sum(), (kernels, features)), wanted)


def test_a_graph_against_loops() -> None:
    points = normal(0, 2, 12, 3)
    found = graph(points, 4)
    for b in range(2):
        for n in range(12):
            distance = (points[b] - points[b, n]).norm(dim=1)
            expected = distance.sort().indices[1:5]
            row = 12 * b + n
            assert set((found.index[row] - 12 * b).tolist()) == set(expected.tolist())
            for k in range(4):
                step = points.flatten(0, 1)[found.index[row, k]] - points[b, n]
                assert_close(found.directions[row, k], step / step.norm())


@pytest.mark.parametrize("count", [1, 2, 5])
def test_small_clouds_have_fewer_neighbours(count: int) -> None:
    found = graph(normal(0, 2, count, 3), 10)
    assert found.index.shape == (2 * count, max(1, count - 1))
    assert bool(torch.isfinite(found.directions).all())


def made(layer: torch.nn.Module) -> None:
    initialise(layer, generator(1))
    layer.double()


def test_convolutions_against_loops() -> None:
    points, x = normal(0, 1, 9, 3), normal(1, 9, 4)
    near = graph(points, 3)
    surface, convolution = Surface(5, 2), Convolution(4, 5, 2)
    for layer in (surface, convolution):
        made(layer)
    first, second = surface(near), convolution(near, x)
    with torch.no_grad():
        for m in range(9):
            for o in range(5):
                total = [0.0, float(convolution.weight[o] @ x[m] + convolution.bias[o])]
                for s in range(2):
                    answers: list[list[float]] = [[], []]
                    for k in range(3):
                        for which, layer in enumerate((surface, convolution)):
                            kernel = layer.directions[:, 5 * s + o]
                            kernel = kernel / kernel.norm()
                            cosine = max(0.0, float(near.directions[m, k] @ kernel))
                            row = 5 + 5 * s + o
                            feature = convolution.weight[row] @ x[near.index[m, k]]
                            weight = float(feature + convolution.bias[row]) if which else 1.0
                            answers[which].append(cosine * weight)
                    total = [t + max(a) for t, a in zip(total, answers, strict=True)]
                assert float(first[m, o]) == pytest.approx(total[0])
                assert float(second[m, o]) == pytest.approx(total[1])


def test_pools_against_loops_and_their_choice() -> None:
    points, x = normal(0, 2, 20, 3), normal(1, 2, 20, 6)
    centres, found = pooled(points, x, 4, None)
    chosen = torch.linspace(0, 19, 5).long()
    assert torch.equal(centres, points[:, chosen])
    for b in range(2):
        for m, n in enumerate(chosen.tolist()):
            near = (points[b] - points[b, n]).norm(dim=1).sort().indices[1:5]
            assert_close(found[b, m], x[b, near].amax(0))
    drawn, _ = pooled(points, x, 4, generator(0))
    again, _ = pooled(points, x, 4, generator(0))
    other, _ = pooled(points, x, 4, generator(1))
    assert torch.equal(drawn, again)
    assert not torch.equal(drawn, other)
    single, _ = pooled(points[:, :2], x[:, :2], 4, None)
    assert single.shape == (2, 1, 3)


def test_features_depend_on_directions_alone() -> None:
    """Moved and scaled clouds look the same, turned ones do not, but for the place at the end."""
    body = Gcn3dBody(gcn3d.cpu_config())
    initialise(body, generator(0))
    with torch.no_grad():
        body.fuse.get_submodule("0").get_parameter("weight")[:, :3] = 0
    body.double().eval()
    points = normal(0, 2, 80, 3)
    one = body(points, None)
    two = body(3 * points + torch.tensor([1.0, -2.0, 0.5]), None)
    assert_close(two.points, one.points)
    assert_close(two.code, one.code)
    three = body(points @ rotations(1).mT, None)
    assert (three.code - one.code).abs().max() > 1e-3


def test_turned_kernels_see_turned_clouds_as_before() -> None:
    """The first layer commutes with rotations of cloud and kernels together."""
    surface = Surface(6, 3)
    made(surface)
    near, turn = graph(normal(0, 1, 30, 3), 5), rotations(2)
    one = surface(near)
    with torch.no_grad():
        surface.directions.copy_(turn @ surface.directions)
    turned = Graph(index=near.index, directions=near.directions @ turn.mT)
    assert_close(surface(turned), one)


def test_the_order_of_the_points_is_followed() -> None:
    """Layers are pointwise; only the pools go by the cloud's order."""
    points = normal(0, 1, 15, 3)
    mixed = torch.randperm(15, generator=generator(4))
    surface = Surface(6, 3)
    made(surface)
    assert_close(surface(graph(points[:, mixed], 5)), surface(graph(points, 5))[mixed])
