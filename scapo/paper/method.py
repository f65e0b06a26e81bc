# SPDX-License-Identifier: MIT
"""SCAPO: canonicalise a cloud, explain it by an articulated template, read parts and joints off.

Read this file first. Stage 1 (`canonicalise`) trains Theta_E and Theta_D to express every cloud in
one canonical frame; stage 2 (`articulate`) trains keypoints, bones, joints and the template so
that blend skinning carries the aligned cloud to the template and back. No label is used unless
`supervision` asks for it. docs/method.md maps the paper's symbols to names here.

Frames: `camera` in metres; `input`, the cloud centred and scaled to mean radius 0.25; `aligned`
(S_obj); `canonical` (S*); `template` (Y_X).

What OP-Align's released evaluator asks of a network (`record_*`, docs/bring-your-own-method.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.categories import Category, JointKind
from scapo.first_weights import initialise
from scapo.geometry.points import Similarity, normalise
from scapo.geometry.rigid import apply, rigid
from scapo.method import AbstractMethod, Mode, ParameterGroup, Stage, Step, changes, evenly
from scapo.paper import losses
from scapo.paper.augment import random_pose
from scapo.paper.autoencoder import Decoder, Encoder, Encoding, mean_encoding
from scapo.paper.config import PRESETS, ScapoConfig
from scapo.paper.figures import articulated_pictures, canonical_pictures
from scapo.paper.first_targets import Inputs, Lying, first_targets, fit_networks, lying
from scapo.paper.heads import (
    JointNetwork,
    KeypointNetwork,
    ResidualNetwork,
    Template,
    opalign_record,
    part_centroids,
    thin,
)
from scapo.paper.objectives import Explanation, articulation, canonicalisation
from scapo.paper.part_search import PartSearch, Skeleton, motionless
from scapo.paper.refine import nearest_template_weights, refine, smoothed_template_weights
from scapo.paper.skinning import Bones, cross_maps, part_maps
from scapo.paper.warm_start import WarmStart, imitation
from scapo.pictures import PictureData
from scapo.records import cat, map_tensors, take
from scapo.registered.method import load_run
from scapo.types import Joints, Labels, Observation, Prediction

UNNAMED = frozenset(
    {"preset", "supervision", "loss.without", "lr", "min_lr", "weight_decay", "start"}
)
"""Options with names of their own in a variant, or that make no other."""
LOOKS = 8
"""How often the encoder is asked about a cloud, but for the mode `fast`."""
CANONICALISE = "canonicalise"
ARTICULATE = "articulate"


class Scapo(AbstractMethod):
    """The method, for one category."""

    name: ClassVar[str] = "scapo"
    networks = ("encoder", "decoder", "joint_network", "keypoint_network", "residual_network")

    def __init__(self, config: ScapoConfig, category: Category, generator: torch.Generator) -> None:
        """Build the networks and draw their weights.

        Args:
            config: Sizes, losses, stages.
            category: Fixes the number of parts and the kind of each joint, nothing else.
            generator: On the CPU; the only source of the initial weights.
        """
        super().__init__()
        self.config = config
        self.category = category
        self.supervision = frozenset(config.supervision)
        self.camera = config.part_start == "run"  # which knows where its cameras stood
        self.least_points = config.encoder.neighbours
        self.kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        parts, code = len(category.parts), config.encoder.code
        with torch.random.fork_rng(devices=[]):  # layers draw before `initialise` draws again
            self.encoder = Encoder(config.encoder)
            self.decoder = Decoder(config.decoder, code)
            self.joint_network = JointNetwork(config.joint, category)
            self.keypoint_network = KeypointNetwork(config.heads, code, parts)
            self.residual_network = ResidualNetwork(config.heads, config.decoder.widths[-1])
            self.template = Template(config.decoder.points, parts)
            self.bones = Bones(parts, config.gamma)
        initialise(self, generator)
        self._run: WarmStart | None = None

    @property
    def variant(self) -> str:
        """The preset, S and J for the labels used, other options, and the ablated terms."""
        config = self.config
        preset = PRESETS[config.preset]()
        words = [] if config.preset == "paper" else [config.preset]
        seen = self.supervision & {"segmentation", "joint"}
        words += ["".join(sorted((label[0].upper() for label in seen), reverse=True))]
        words += ["objects known"] if "instance" in self.supervision else []
        words += changes(config, preset, leave=UNNAMED)
        words += [f"wo_{term}" for term in config.loss.without]
        return "-".join(word for word in words if word)

    def stages(self) -> tuple[Stage, ...]:
        """Two stages of Adam with cosine annealing (Sec. 4)."""
        config = self.config
        epochs = config.epochs * 2 if len(config.epochs) == 1 else config.epochs
        rates = [(1.0, 0.0)] * 5
        modules = ["joint_network", "keypoint_network", "residual_network", "template", "bones"]
        late = {"joint": (0.1, 0.5), "end-to-end": (1.0, 0.0)}.get(config.encoder_in_stage_2)
        if late is not None:
            modules += ["encoder", "decoder"]
            rates += [late] * 2
        groups = tuple(
            ParameterGroup(module=module, rate=rate, begin=begin)
            for module, (rate, begin) in zip(modules, rates, strict=True)
        )
        first = (ParameterGroup(module="encoder"), ParameterGroup(module="decoder"))
        told = config.told if config.part_start == "run" else None
        return tuple(
            Stage(
                name=name,
                epochs=epochs,
                lr=lr,
                min_lr=config.min_lr,
                weight_decay=config.weight_decay,
                batch=config.batch,
                clouds=clouds,
                parameters=parameters,
            )
            for name, epochs, lr, clouds, parameters in zip(
                (CANONICALISE, ARTICULATE), epochs, config.lr, (told, None), (first, groups),
                strict=True,
            )
        )  # fmt: skip

    @torch.no_grad()
    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Before stage 2: the decoded medoid of (at most 2,000) codes into the template, and parts.

        With `part_start` search or run, template, bones, joints and the networks' first answers
        are then those of the search or of the run.

        Raises:
            StoreError: No such run.
            ValueError: None was named.
        """
        del labels
        config, number = self.config, observation.points.shape[0]
        asked = self._ask(observation, generator)
        if stage != ARTICULATE or config.template_start == "random":
            return
        chosen = torch.randperm(number, generator=generator, device=generator.device)[:2000]
        if config.part_start == "run":
            chosen = asked
        self.eval()
        clouds = normalise(observation.points[chosen])[0]
        count = config.points or clouds.shape[1]
        seen = cat([self._decoded(thin(some, count))[0] for some in clouds.split(64)])
        medoid = int(torch.cdist(seen.code, seen.code).sum(1).argmin())
        shape = self.decoder(seen.code[medoid, None])[0][0]
        keypoints = part_centroids(shape, len(self.category.parts))
        self.template.set_to(shape, keypoints)
        self.keypoint_network.start_at(keypoints)
        if config.part_start == "search":
            some = slice(config.search.taught)
            skeleton, own = self._searched(seen.align(clouds), medoid)
            self.template.part.copy_(skeleton.weights().argmax(-1))
            self._teach(
                skeleton, own, clouds[some], map_tensors(seen, lambda x: x[some]), generator
            )
        elif config.part_start == "run":
            told = self._warm().read(take(observation, chosen), chosen, seen)
            order = told.order(shape, medoid, self.kinds)
            skeleton = told.skeleton(order, config.search.spread)
            self.template.part.copy_(told.part[0, order])
            self._teach(skeleton, told.lying(order, seen), clouds, seen, generator)

    def recall(self, stage: str, observation: Observation, generator: torch.Generator) -> None:
        """What the run says of the clouds that take the place of stage 1's losses."""
        if stage == CANONICALISE:
            self._ask(observation, generator)

    def _ask(self, observation: Observation, generator: torch.Generator) -> Int[Tensor, " K"]:
        """Have the run's answers about some clouds, if there is a run; their rows."""
        asked = evenly(observation.points.shape[0], self.config.told).to(generator.device)
        if self.config.part_start == "run":
            self._warm().ask(observation, asked, generator, self.journal)
        return asked

    def _warm(self) -> WarmStart:
        """The run that tells where the networks begin."""
        if self._run is None:
            if self.config.start is None:
                raise ValueError(
                    "--start: expected a trained `registered`, run folder or name, found none; "
                    "`scapo-bench train registered --category C --data DIR --out RUN` makes one"
                )
            run = load_run(self.config.start, self.category)
            hidden = " ".join(sorted(run.supervision - self.supervision))
            if hidden:  # what the run learned from, this training learns from too
                raise ValueError(
                    f"supervision: expected what {self.config.start} was told, {hidden}, "
                    f"found it left out; add --supervision {hidden}"
                )
            run.strip()  # it goes to the workers with every lot of clouds
            self._run = WarmStart(run, "whole" if self.config.told_of == "surfaces" else "quick")
        return self._run

    def _searched(self, aligned: Float[Tensor, "B N 3"], medoid: int) -> tuple[Skeleton, Lying]:
        """What the search of parts finds, and how it lies in the clouds to be learned."""
        config = self.config.search
        parts = PartSearch(self.kinds, config)
        found, _ = parts.search(aligned[medoid], aligned)
        skeleton = found.laid_over(self.template.points)
        some = aligned[: config.taught]
        at, _ = parts.place(some, found, motionless(some, len(self.kinds)), config.placing)
        return skeleton, lying(skeleton, at)

    def _teach(
        self,
        skeleton: Skeleton,
        own: Lying,
        clouds: Float[Tensor, "B N 3"],
        seen: Encoding,
        generator: torch.Generator,
    ) -> None:
        """Template, bones and networks as the skeleton lies in some clouds."""
        self.template.set_to(skeleton.points, skeleton.keypoints)
        self.bones.set_to(skeleton.precision())
        features = [self.decoder(codes)[1] for codes in seen.code.split(64)]
        fit_networks(
            (self.joint_network, self.keypoint_network, self.residual_network),
            Inputs(
                template=skeleton.points,
                aligned=seen.align(clouds),
                code=seen.code,
                features=torch.cat(features),
            ),
            first_targets(skeleton.points, own, self.kinds),
            generator,
            self.config.search.teaching,
            self.journal,
        )

    def _decoded(
        self, points: Float[Tensor, "B N 3"]
    ) -> tuple[Encoding, Float[Tensor, "B M 3"], Float[Tensor, "B M C"]]:
        """A cloud's encoding by the pose that explains it best, S_dec and F_x."""
        encoding = self.encoder(points)
        shape, features = self.decoder(encoding.code)
        return encoding.nearest(points, shape, self.config.encoder), shape, features

    def _looked(
        self, points: Float[Tensor, "B N 3"], looks: int
    ) -> tuple[Encoding, Float[Tensor, "B M C"]]:
        """A cloud's encoding and F_x; of several looks, each at other points of it, their mean.

        The encoder asks at a few dozen centres among the points that it sees: what it says of
        other points of a cloud differs by as much as it errs (row 347 of the experiments).
        """
        number = points.shape[1]
        count = self.config.points or number
        if looks == 1 or count >= number:
            encoding, _, features = self._decoded(thin(points, count))
            return encoding, features
        generator = torch.Generator().manual_seed(0)
        orders = [torch.randperm(number, generator=generator)[:count] for _ in range(looks)]
        encoding = mean_encoding([self._decoded(points[:, some])[0] for some in orders])
        return encoding, self.decoder(encoding.code)[1]

    def explain(self, points: Float[Tensor, "B N 3"], looks: int = 1) -> Explanation:
        """Run every network on clouds in the input frame.

        Args:
            points: Normalised.
            looks: How often the encoder is asked, where it does not see all points of a cloud.
        """
        encoding, features = self._looked(points, looks)
        aligned = encoding.align(points)
        residual = self.residual_network(features)
        template = self.template.points + residual
        keypoints = self.keypoint_network(encoding.code)
        template_keypoints = self.template.keypoints.expand_as(keypoints)
        joints, template_joints = self.joint_network.pair(aligned, template)
        turn = None
        if self.config.bones_turn:
            turn = part_maps(cross_maps(template_joints, joints, self.kinds))[..., :3, :3]
        return Explanation(
            encoding=encoding,
            aligned=aligned,
            template=template,
            residual=residual,
            keypoints=keypoints,
            template_keypoints=template_keypoints,
            joints=joints,
            template_joints=template_joints,
            weights=self.bones.weights(aligned, keypoints, turn),
            bone_turn=turn,
            template_weights=self.bones.weights(template, template_keypoints),
        )

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The terms of the stage for a batch in random poses, times their weights."""
        points, similarity = normalise(observation.points)
        config = self.config.loss
        labels, points = self._drawn(labels, points, step.generator)
        pose = random_pose(points.shape[0], config.shift, step.generator, points)
        points = apply(pose, points)
        if step.stage == CANONICALISE:
            if self.config.part_start == "run":
                encoding, shape, _ = self._decoded(points)
                told = self._warm().read(observation, step.index, encoding, pose)
                return imitation(encoding, shape, told, self.kinds, config)
            return canonicalisation(self.encoder, self.decoder, points, config, step.generator)
        self._freeze(step)
        explanation = self.explain(points)
        terms = articulation(explanation, self.bones, self.kinds, config)
        return terms | self._labelled(explanation, labels, similarity, pose)

    def _drawn(
        self, labels: Labels, points: Float[Tensor, "B N 3"], generator: torch.Generator
    ) -> tuple[Labels, Float[Tensor, "B K 3"]]:
        """The points of each cloud, and their part labels, that this step uses."""
        count, number = self.config.points, points.shape[1]
        if count is None or count >= number:
            return labels, points
        some = torch.randperm(number, generator=generator, device=points.device)[:count]
        part = None if labels.part is None else labels.part[:, some]
        return replace(labels, part=part), points[:, some]

    def _freeze(self, step: Step) -> None:
        """Stage 1's networks as they stand, batch statistics included, until they join."""
        choice = self.config.encoder_in_stage_2
        frozen = choice == "frozen" or (choice == "joint" and step.progress < 0.5)
        for network in (self.encoder, self.decoder):
            network.train(not frozen)

    def _labelled(
        self,
        explanation: Explanation,
        labels: Labels,
        similarity: Similarity,
        pose: Float[Tensor, "B 4 4"],
    ) -> dict[str, Tensor]:
        """The supervised terms of Table 2's variant, in the input frame."""
        config, encoding, found = self.config.loss, explanation.encoding, explanation.joints
        if labels.joints is not None:
            pivot = apply(pose, similarity.forward(labels.joints.pivot))
            axis = labels.joints.axis @ pose[:, :3, :3].mT
            labels = replace(labels, joints=replace(labels.joints, pivot=pivot, axis=axis))
        joints = encoding.place(found.pivot), found.axis @ encoding.rotation.mT
        scales = config.labelled_segmentation, config.labelled_joints
        return losses.labelled(explanation.weights, joints, labels, self.category, scales)

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """Canonicalised clouds, reconstructions; in stage 2 the template and the posed template."""
        points, _ = normalise(observation.points)
        explanation = self.explain(points)
        if stage == CANONICALISE:
            shape, _ = self.decoder(explanation.encoding.code)
            return canonical_pictures(explanation, shape)
        return articulated_pictures(explanation, self.bones, self.kinds)

    def _as_told(self, e: Explanation) -> Explanation:
        """With the parts that the template's points were told in place of the bones' weights."""
        told = F.one_hot(self.template.part.long(), len(self.category.parts)).to(e.aligned)
        return replace(e, template_weights=told.expand_as(e.template_weights))

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Weights on S_obj, joints by (R_g, t_g), part poses global o T_{Y->X} (docs/method.md).

        The part frames are the template's: every part's pose carries the template onto the
        cloud. States are those of the cloud minus the template's. `fast` asks each network once,
        `quick` the encoder about several samplings of the cloud, and `refine` then moves pose and
        joints of each cloud until the posed template, told parts as hard ones, fits it; `labels_of`
        takes the template's weights or parts (none of these in the paper).
        """
        points, similarity = normalise(observation.points)
        explanation = self.explain(points, 1 if mode == "fast" else LOOKS)
        if self.config.labels_of == "told":
            explanation = self._as_told(explanation)
        if mode == "refine":
            explanation = refine(points, explanation, self.kinds)
        encoding, joints = explanation.encoding, explanation.joints
        maps = part_maps(cross_maps(explanation.template_joints, joints, self.kinds))
        pose = rigid(encoding.rotation, encoding.translation)[:, None] @ maps
        state = joints.relative() - explanation.template_joints.relative()
        slide = torch.tensor([kind == "prismatic" for kind in self.kinds], device=state.device)
        scale, weights = similarity.scale[:, None], explanation.weights
        shift = (encoding.rotation.mT @ encoding.translation[..., None])[..., 0]
        if self.config.labels_of == "told":
            weights = smoothed_template_weights(points, explanation, self.kinds)
        elif self.config.labels_of == "template":
            weights = nearest_template_weights(points, explanation, self.kinds)
        return Prediction(
            part_weight=weights,
            camera_T_part=similarity.inverse_pose(pose),
            joints=Joints(
                pivot=similarity.inverse(encoding.place(joints.pivot)),
                axis=joints.axis @ encoding.rotation.mT,
                state=torch.where(slide, state / scale, state),
            ),
            canonical_points=explanation.template / scale[..., None],
            canonical_part=explanation.template_weights.argmax(-1),
            record=opalign_record(encoding.rotation, shift, joints, explanation.template_joints),
        )
