# SPDX-License-Identifier: MIT
"""What each job of the bench is asked: dataclasses whose fields are the flags of its verb.

Light to import, so that the command line can show its help without the networks; the plain
function of each job (`bench.runs.predict.predict`, `bench.scoring.evaluate.evaluate`, ...) takes
one of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import tyro

from bench.matching import LabelOrder
from bench.metrics import ApRule, IouKind, PivotKind, RotationKind
from scapo.ranges import ANY, CountOrNone, Port, Positive, Seed
from scapo.text import UsageError

Mode = Literal["fast", "quick", "refine", "whole"]
"""`scapo.method.Mode`, written out: that module loads torch."""
Precision = Literal["float32", "bfloat16", "float16"]
"""`scapo.training.precision.Precision`, likewise."""
Geometry = Literal["se3", "opalign-compat"]
Ambiguity = Literal["off", "on"]
Kind = Literal["constant", "oracle-pose"]
"""The answers of `reference`."""

M = TypeVar("M")


def _some(name: str) -> Any:  # noqa: ANN401 - tyro does not name its type
    """One or more words; the parser takes none as well, which `require_some` refuses."""
    return tyro.conf.arg(metavar=f"{name}...", help_behavior_hint="(required)")


def require_some(name: str, found: Sequence[Path]) -> None:
    """Refuse a verb without what it is about.

    Raises:
        UsageError: Naming it.
    """
    if not found:
        raise UsageError(f"{name}: expected one or more, found none")


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The readings of the metrics (docs/protocol.md); the defaults are the benchmark's."""

    geometry: Geometry = "se3"
    """Rigid geometry, or OP-Align's released evaluator on `record_*` tensors."""
    ap_rule: ApRule = "mean"
    """How the parts of a sample join in the average precision."""
    pivot: PivotKind = "point-line"
    """Distance of the predicted pivot to the true axis, or between the two axes."""
    label_order: LabelOrder = "sample"
    """Part order chosen per sample, once per data set, or by Hungarian matching per sample."""
    iou: IouKind = "hard"
    """Intersection over union of labels, or of weights."""
    rotation: RotationKind = "full"
    """Rotation errors up to 180 degrees, or folded to 90."""
    ambiguity: Ambiguity = "off"
    """Score against the truth, or against the best of the turns that look alike where the data say
    so (docs/ambiguity.md)."""

    def changes(self) -> str:
        """What differs from the defaults and changes per-sample scores, for the variant's name."""
        names = ("geometry", "pivot", "label_order", "iou", "rotation", "ambiguity")
        default = Settings()
        changed = [n for n in names if getattr(self, n) != getattr(default, n)]
        return ",".join(f"{n.replace('_', '-')}={getattr(self, n)}" for n in changed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What to score, how, and where the results go."""

    predictions: Path
    """Predictions (safetensors, docs/bring-your-own-method.md)."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Where the results go."""
    split: str = "test"
    """Split that was predicted."""
    calibration: Path | None = None
    """Predictions of the same run on the training split, to fit the frames of a method that saw
    no poses. Without it poses are compared as given."""
    settings: tyro.conf.Suppress[tyro.conf.Fixed[Settings]] = field(default_factory=Settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateRequest(Request):
    """What to score, and whether what stands beside it in a table is scored too."""

    out: Path
    """Scores per sample, NAME.csv.gz; the report NAME.json is written beside it."""
    companions: bool = True
    """With the benchmark's readings: also score, for the tables, one part order for the whole data
    set (NAME.one-order.csv.gz), the best of the turns that look alike where the data say so
    (NAME.ambiguity.csv.gz), and a constant answer and one that is told the true base pose
    (references/ beside NAME.csv.gz, where the data have the split train; kept while data and code
    stay the same)."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRequest:
    """Which answers that are no method, on what."""

    kind: tyro.conf.Positional[Literal["constant", "oracle-pose", "both"]]
    """A constant answer, one that is told the true base pose, or both."""
    data: Path
    """Data set: the folder above CATEGORY/train and CATEGORY/SPLIT."""
    category: str
    """Category to predict."""
    out: Path | None = None
    """Predictions file (safetensors) of one of the two for evaluate."""
    scores: Path | None = None
    """Folder of scores: theirs are written to references/ there, as evaluate does by itself when
    it scores a method."""
    split: str = "test"
    """Split to predict."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """A trained method and the data it is shown."""

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, checkpoint file, or name of a released model, such as a category."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictRequest(RunRequest):
    """What to predict, and how."""

    out: Path
    """Predictions file, NAME.safetensors."""
    split: str = "test"
    """Split to predict."""
    mode: Mode = "fast"
    """fast: networks only; refine: with optimisation at test time; quick: with a little of it;
    whole: for clouds that show all of an object, not the side that a camera sees."""
    oracle: bool = False
    """Show a method that can use them true labels of the test split (icp: the parts); the
    variant then begins with oracle."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, ..."""
    batch: int = 32
    """Clouds at a time."""
    limit: int | None = None
    """Predict so many clouds alone, evenly spread over the split (500 are enough to calibrate);
    the others have no answer in the file."""
    up: bool = False
    """Tell the method which way is up, as robots know it: in these data the z axis of the base. The
    variant then ends with up."""
    own_frame: bool = False
    """Leave poses, order of parts and states as a method that saw no poses has them, and not in
    the object's frame, where its checkpoint knows that."""
    row: str = ""
    """What tables call the training, in place of what it differs by from its method's usual one;
    runs of one row of a table have one name. The mode is added to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StabilityRequest(RunRequest):
    """How much of a method's stability is measured."""

    out: Path
    """Report, FILE.json."""
    split: str = "test"
    """Split whose clouds are used, without labels."""
    mode: Literal["fast", "quick", "refine", "both"] = "both"
    """Inference modes to measure; both: fast and refine."""
    samples: int = 20
    """Clouds, evenly spread over the split."""
    motions: int = 2
    """Random motions of each kind for each cloud."""
    resamplings: CountOrNone = 20
    """Random subsets of each cloud; 0 for none."""
    points: int | None = None
    """Points of a subset; by default half of the clouds' own, at most 1,024. Data generated with
    --points 4096 have new points to draw, where halves of 1,024 share theirs."""
    seed: Seed = 0
    """Seed of the motions and subsets."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, ..."""
    batch: int = 32
    """Clouds at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PicturesRequest(RunRequest):
    """What is drawn of a run."""

    predictions: Path
    """Predictions of that run (safetensors)."""
    out: Path
    """Folder for overlay.png, template.png, ranking.png and training.png."""
    split: str = "test"
    """Split that was predicted."""
    calibration: Path | None = None
    """Predictions of the same run on the training split, as for evaluate: they put a method that
    saw no poses into the true frame, so that its figures are upright."""
    clouds: int = 24
    """Clouds in overlay.png, evenly spread over the split."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyRequest:
    """Which runs are studied, and on what."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, _some("RUN")]
    """Run folders, of any methods and categories."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Folder for predictions/, scores/, ladders/, pictures/, stability/ and README.md."""
    split: str = "test"
    """Split to score."""
    mode: Literal["fast", "quick", "refine", "both"] = "both"
    """Inference modes to study; both: fast and refine."""
    calibration: int = 500
    """Training clouds that fix the frames of a method that saw no poses."""
    samples: CountOrNone = 20
    """Clouds for stability; 0 leaves it out."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, ..."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainRequest(Generic[M]):
    """Which method is fitted to what, and how."""

    method: Annotated[M, tyro.conf.arg(name="")]
    category: str
    """Category of the data."""
    data: Path
    """Data set: the folder above CATEGORY/train, or above that of a benchmark."""
    out: Path
    """Run folder."""
    split: str = "train"
    """Split to train on."""
    val_split: str = "val"
    """Split for methods with a validation pass; without it, every tenth object of --split."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, cuda:1, ..."""
    seed: Seed = 1
    """Seed of the first weights, the order of the data and the augmentation."""
    workers: CountOrNone | None = None
    """Processes for what the start of a stage can do side by side, beside this one, which waits;
    by default as many as torch has threads (OMP_NUM_THREADS)."""
    resume: bool = False
    """Continue the run in that folder, or begin it where there is none."""
    log_every: int = 10
    """Steps between two lines of metrics.jsonl."""
    checkpoint_every: float = 60.0
    """Seconds after which the end of an epoch saves the state."""
    precision: Precision = "float32"
    """Number type of the networks' matrix products; geometry and losses stay float32."""
    compile: bool = False
    """Compile the networks, on CUDA with CUDA graphs."""
    tf32: bool = True
    """On CUDA, float32 matrix products of networks with 10-bit mantissas."""
    pictures_every: float = 300.0
    """Seconds after which the end of an epoch draws pictures, as does the end of a stage."""
    pictures: bool = True
    """Draw pictures at all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseRequest(RunRequest):
    """A finished run, and what its card is made from."""

    out: Path
    """Released checkpoint: results/checkpoints/CATEGORY.safetensors of the method that answers by
    default, CATEGORY-METHOD.safetensors of another. Its card is written beside it, ten answers to
    checks/ beside its folder."""
    scores: Path | None = None
    """Folder of scores; those of this run go into the card."""
    split: str = "val"
    """Split of the clouds whose answers are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridRequest:
    """Which grid is run, on what, and how."""

    preset: tyro.conf.Positional[Literal["smoke", "cpu", "paper"]]
    """smoke: three methods on a few ovens, under three minutes; cpu: every table with the lean
    presets; paper: with the published sizes, for GPUs."""
    out: Path | None = None
    """Folder for plan.json, runs/, predictions/, scores/, tables/ and jobs/ (records and logs); by
    default results/runs/PRESET."""
    data: Path | None = None
    """Folder of the data, PART/CATEGORY/SPLIT; by default OUT/data. What is missing is made by
    scapo-data."""
    only: tuple[str, ...] = ()
    """Only these trainings: patterns of parts, categories, methods or seeds (clean, oven, scapo*,
    seed1), or several joined by /, such as clean/registered."""
    splits: tuple[str, ...] = ()
    """Splits to score, such as val while a method is being made; by default test and test-ood."""
    budget_minutes: Positive | None = None
    """Time of each training on one core, which bounds its epochs; by default the preset's."""
    real: Path | None = None
    """Real models of yours, PATH/CATEGORY/ID/*.urdf, to be scored too."""
    engine: Literal["local", "ray"] = "local"
    """Where trainings run: on this machine, or on the Ray cluster of RAY_ADDRESS, whose machines
    all see OUT under the same name."""
    workers: CountOrNone | None = None
    """Trainings at a time; by default one per core, or one where there is a GPU."""
    gpus: float = 0.0
    """GPUs of each training: what Ray is asked for. From 2 on a training runs as so many processes
    of torchrun."""
    plan_only: bool = False
    """Write plan.json, show what it comes to, and stop."""
    replan: bool = False
    """Write plan.json anew where it differs; what is finished and still the same stays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelRequest:
    """Which model answers, and how."""

    checkpoint: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """Run folder or checkpoint of the model."""
    category: str | None = None
    """Category whose released model answers. With neither, every released model is asked, and the
    one whose shape explains the view best is taken."""
    mode: Mode = "refine"
    """fast: networks only; refine: with optimisation at test time; quick: with a little of it;
    whole: for clouds that show all of an object, not the side that a camera sees."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, ..."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InferRequest(ModelRequest):
    """Somebody's files, and what they do not say themselves."""

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, _some("INPUT")]
    """Clouds (.ply, .pcd, .npz with points [, color, sensor]), depth images (.png, .tif) and
    folders of these."""
    out: Path
    """Folder for the results, in OUT/NAME/ for each input NAME.ply."""
    mask: Path | None = None
    """Image that is not 0 where a depth image shows the object; else NAME.mask.png beside it, else
    the nearest thing that is neither floor nor wall is taken."""
    intrinsics: str | None = None
    """Camera of a depth image: fx,fy,cx,cy in pixels, or a JSON or YAML file; else NAME.json,
    NAME.yaml, intrinsics.json or intrinsics.yaml beside it."""
    scale: Positive | None = None
    """Metres in one unit of the input; by default 0.001 for images of whole numbers, else 1."""
    sensor: Annotated[tuple[float, float, float] | None, ANY] = None
    """Centre of the camera in metres, for clouds in another frame than the camera's."""
    up: Annotated[tuple[float, float, float] | None, ANY] = None
    """Against gravity in the frame of the input (of a level camera 0 -1 0), where that is known and
    objects stand upright: models of template registration then turn none over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateRequest:
    """A model, and the labelled clouds that it is compared with."""

    checkpoint: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, checkpoint, or category with a released model."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    split: str = "val"
    """Labelled split, which the model was not trained on and is not scored on."""
    mode: Mode = "refine"
    """Inference mode that is calibrated, each for itself."""
    limit: int | None = 300
    """Samples, evenly spread over the split, each asked six times."""
    picture: Path | None = None
    """Reliability diagram, FILE.png."""
    device: str = "auto"
    """Where the networks run: auto (CUDA where there is a GPU), cpu, cuda, ..."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoRequest(ModelRequest):
    """Where the page is served, and what it takes."""

    port: Port = 8000
    """Port of the page."""
    host: str = "127.0.0.1"
    """Address that is listened at; 0.0.0.0 lets other machines in."""
    max_upload: int = 64
    """Megabytes of an upload."""
    queue: int = 64
    """Uploads that may wait; more are sent away."""
    keep: int = 100
    """Results that are kept."""
