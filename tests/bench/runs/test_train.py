# SPDX-License-Identifier: MIT
"""train and predict as a user types them: files in, files out, the header says what was done."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from bench.__main__ import main
from bench.cli.verbs import prepare
from bench.methods import METHODS, load
from bench.requests import PredictRequest
from bench.runs import predict as predicting
from bench.runs.train import pick_device
from bench.scoring.scores import to_arrays
from scapo import released
from scapo.method import OracleMethod
from scapo.paper.method import Scapo
from scapo.store import open_split
from scapo.store.files import read, read_header
from scapo.store.predictions import Predictions, read_prediction_header
from scapo.store.samples import SampleDataset
from scapo.store.schema import StoreError
from scapo.types import Prediction
from tests.helpers.small import FLAGS, POINTS, hinged_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hinged_data(tmp_path_factory.mktemp("data"))


def command(*words: object) -> None:
    main([str(word) for word in words])


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "scapo"
    command("train", "scapo", "--category", "laptop", "--data", data, "--out", out, "--device",
            "cpu", *FLAGS["scapo"])  # fmt: skip
    return out


def test_an_interrupt_amid_the_import_of_the_first_picture_is_one(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def struck(*_: object) -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr("scapo.pictures.render", struck)
    with pytest.raises(SystemExit) as stop:
        command("train", "scapo", "--category", "laptop", "--data", data, "--out", tmp_path,
                "--device", "cpu", *FLAGS["scapo"])  # fmt: skip
    assert stop.value.code == 130
    assert "interrupted; saved after step 0" in capsys.readouterr().err


def test_the_run_is_that_of_the_flags(run: Path) -> None:
    config = read_header(run / "checkpoint.safetensors")["config"]
    assert config["preset"] == "cpu"
    assert config["epochs"] == [1]
    assert config["encoder"]["centres"] == 16
    assert config["loss"]["recon_form"] == "partial"
    method, header = load(run)
    assert isinstance(method, Scapo)
    assert not method.training
    assert header["category"] == "laptop"


def test_the_flags_of_speed_reach_the_run(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command("train", "scapo", "--category", "laptop", "--data", data, "--out", out, "--device",
            "cpu", *FLAGS["scapo"],
            "--precision", "bfloat16", "--no-tf32", "--no-pictures")  # fmt: skip
    training = read_header(out / "checkpoint.safetensors")["training"]
    assert training == {
        "precision": "bfloat16",
        "compiled": False,
        "tf32": False,
        "clip": 10.0,
        "ranks": 1,
    }
    assert (out / "report.html").is_file()
    assert not (out / "pictures").exists()


def test_resume_leaves_a_finished_run(run: Path, data: Path) -> None:
    before = (run / "checkpoint.safetensors").read_bytes()
    command("train", "scapo", "--category", "laptop", "--data", data, "--out", run, "--device",
            "cpu", *FLAGS["scapo"], "--resume")  # fmt: skip
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_predictions_are_those_that_evaluate_reads(run: Path, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "p.safetensors"
    command("predict", run, "--data", data, "--out", out, "--device", "cpu", "--batch", "2")
    split = open_split(data, "laptop", "test")
    with Predictions(out, split) as predictions:
        rows = predictions.rows(0, 5)
        predictions.finish()
    assert rows["part_weight"].shape == (5, POINTS, 2)
    header = read_prediction_header(out)
    assert (header.method, header.variant, header.supervision) == ("scapo", "cpu", ())
    assert header.data_digest == split.manifest.digest
    assert header.budget["parameters"] > 1000
    assert header.budget["training_seconds"] > 0
    assert 0.05 < header.budget["training_gigabytes"] < 100
    assert header.budget["seconds_per_cloud"] > 0
    assert (header.budget["device"], header.budget["batch"]) == ("cpu", 2)
    assert "cores" in header.budget["processor"]
    assert header.camera is False
    trained = read_header(run / "checkpoint.safetensors")
    for name in ("commit", "config", "machine", "data_digest", "training", "seed"):
        assert header.run[name] == trained[name], name
    one = tmp_path / "one.safetensors"
    command("predict", run, "--data", data, "--out", one, "--device", "cpu", "--batch", "5")
    for name, value in read(one)[0].items():
        np.testing.assert_allclose(value, read(out)[0][name], atol=1e-4)


@pytest.mark.parametrize("flag", ["--limit", "--batch"])
@pytest.mark.parametrize("count", [0, -3])
def test_no_clouds_are_refused(
    flag: str, count: int, run: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "p.safetensors"
    said = fails(capsys, "predict", run, "--data", data, "--out", out, flag, count)
    assert f"{flag[2:]}: expected 1 or more, found {count}" in said
    assert not out.exists()


def test_a_released_model_is_asked_by_its_category(
    run: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(released, "weights", lambda: {"laptop": run / "checkpoint.safetensors"})
    monkeypatch.chdir(tmp_path)
    command("predict", "laptop", "--data", data, "--out", "named.safetensors", "--device", "cpu")
    command("predict", run, "--data", data, "--out", "run.safetensors", "--device", "cpu")
    for name, value in read(tmp_path / "run.safetensors")[0].items():
        np.testing.assert_array_equal(value, read(tmp_path / "named.safetensors")[0][name])
    words = ("--predictions", "named.safetensors", "--clouds", 2, "--out", "drawn")
    command("pictures", "laptop", "--data", data, *words)
    assert (tmp_path / "drawn/ranking.png").is_file()


def test_the_time_of_a_cloud_is_the_methods_alone(
    run: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that reading moves by 100 seconds and answering by two."""
    now = [0.0]

    def slowed(seconds: float, function: Callable[..., Any]) -> Callable[..., Any]:
        def slow(*arguments: Any) -> Any:
            now[0] += seconds
            return function(*arguments)

        return slow

    monkeypatch.setattr(predicting, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(SampleDataset, "batch", slowed(100, SampleDataset.batch))
    monkeypatch.setattr(predicting, "_answer", slowed(2, predicting._answer))
    out = tmp_path / "p.safetensors"
    asked = PredictRequest(checkpoint=run, data=data, out=out, device="cpu", batch=2)
    count, seconds = predicting.predict(asked)
    assert (count, seconds) == (5, pytest.approx(3 * 2 / 5))  # three batches
    assert read_prediction_header(out).budget["seconds_per_cloud"] == pytest.approx(1.2)


def test_icp_with_and_without_its_oracle(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "icp"
    command("train", "icp", "--category", "laptop", "--data", data, "--out", run, *FLAGS["icp"])
    for words, variant in (
        ((), ""),
        (("--oracle",), "oracle-segmentation"),
        (("--row", "mine", "--oracle"), "mine-oracle-segmentation"),
    ):
        out = tmp_path / f"{variant}p.safetensors"
        command("predict", run, "--data", data, "--out", out, *words)
        header = read_prediction_header(out)
        assert header.variant == variant
        assert header.supervision == ("instance", "joint", "pose", "segmentation")
    assert (run / "metrics.jsonl").read_text() == ""


def fails(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as caught:
        command(*words)
    assert caught.value.code == 1
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def test_bad_input_is_one_line(
    run: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", tmp_path / "x.safetensors"]
    assert "expected a run folder, a checkpoint or a category" in fails(
        capsys, "predict", tmp_path / "none", "--data", data, *out
    )
    assert "--oracle: expected a method that takes one, found scapo" in fails(
        capsys, "predict", run, "--data", data, *out, "--oracle"
    )
    assert "expected laptop/wrong" in fails(
        capsys, "predict", run, "--data", data, *out, "--split", "wrong"
    )
    few = hinged_data(tmp_path / "few", points=4)
    assert "points or more, as scapo needs with these flags, found 4" in fails(
        capsys, "predict", run, "--data", few, *out
    )
    assert "expected clouds of 300 points or more, as scapo needs with these flags, found" in fails(
        capsys, "train", "scapo", *("--category", "laptop", "--data", data, *out),
        *("--preset", "cpu", "--encoder.neighbours", 300),
    )  # fmt: skip
    assert "--device cuda:99: expected a device of this machine" in fails(
        capsys, "predict", run, "--data", data, *out, "--device", "cuda:99"
    )


def test_wrong_usage_ends_with_two(data: Path, tmp_path: Path) -> None:
    teapot = ["--category", "teapot", "--out", str(tmp_path / "out")]
    for words in (
        ["train"],
        ["train", "none"],
        ["train", "scapo", "--bogus", "1"],
        ["train", "icp", *teapot, "--data", str(data)],
        ["infer", str(tmp_path / "cloud.ply"), *teapot],
        ["predict"],
    ):
        with pytest.raises(SystemExit) as caught:
            command(*words)
        assert caught.value.code == 2


def test_flags_are_prepared_before_they_are_parsed() -> None:
    words = ["train", "scapo", "--supervision=segmentation,joint", "--preset=cpu"]
    assert prepare(words) == (
        ["train", "scapo", "--supervision", "segmentation", "joint", "--preset", "cpu"],
        "cpu",
    )
    assert prepare(["evaluate", "--x", "a,b"]) == (["evaluate", "--x", "a,b"], None)


def test_presets_and_kinds() -> None:
    entry = METHODS["scapo"]
    assert entry.preset(None).preset == "paper"
    assert entry.preset("cpu").preset == "cpu"
    assert entry.preset("of another method") == entry.preset(None)
    assert entry.kind is type(entry.preset("cpu"))


def test_a_checkpoint_of_no_known_method_is_refused(run: Path, tmp_path: Path) -> None:
    from scapo.store.files import write

    arrays, header = read(run / "checkpoint.safetensors")
    path = tmp_path / "c.safetensors"
    write(path, arrays, {**header, "method": "magic"})
    with pytest.raises(StoreError, match=r"expected a method of scapo, .*icp.*, found 'magic'"):
        load(path)


def test_devices() -> None:
    assert pick_device("cpu") == "cpu"
    assert pick_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")


def test_what_is_not_predicted_is_left_out() -> None:
    arrays = to_arrays(Prediction(part_weight=torch.ones(1, 2, 1), confidence=torch.ones(1)))
    assert {name: array.dtype.name for name, array in arrays.items()} == {
        "part_weight": "float32",
        "confidence_sample": "float32",
    }


def test_only_oracle_methods_are_shown_labels() -> None:
    assert not issubclass(Scapo, OracleMethod)
    assert "predict_given" in OracleMethod.__abstractmethods__
