"""Conformalized quantile regression with a forest: the spread of a point network's residuals.

The paper's section III-A. A point network predicts the pose. A quantile regression forest takes the
compressed features and that pose and predicts the 5 % and 95 % quantiles of the residual

    e = (t - t_hat, Log(R_hat^T R)),

which never wraps and has a far smaller range than the pose. Residuals of frames that the point
network was trained on are too small. They therefore come from networks trained on the other folds
(``cross_fitted``), or from the role ``fit`` with a network trained on ``train`` (``held_out``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import onnx
import torch
from msgspec import Meta, Struct
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from cvo_edge.heads import Candidate
from cvo_edge.heads.cqr import CqrParameters
from cvo_export.networks.forest import (
    ML_DOMAIN,
    ML_OPSET,
    Forest,
    forest_fields,
    grow,
    quantile_nodes,
)
from cvo_export.networks.heads.base import (
    DOF,
    ExportedHead,
    Lessons,
    Method,
    Setting,
    half_width_floor,
    interval_candidates,
)
from cvo_export.networks.heads.point import (
    COMPONENTS,
    FeatureNoise,
    Hidden,
    PointNetwork,
    Residuals,
    check_components,
    compressed,
    deviation_of,
    learn_held_out,
    principal_components,
    residuals_of,
)
from cvo_export.networks.standardised import PoseDecoder

Array = NDArray[np.float64]


class CqrConfig(Struct, frozen=True, tag="cqr", tag_field="method", forbid_unknown_fields=True):
    """Options of the forest and of its point network."""

    quantiles: Annotated[
        tuple[float, float],
        Meta(description="Levels of lower and upper bound before conformalising."),
    ] = (0.05, 0.95)
    trees: Annotated[int, Meta(ge=1, le=10_000, description="Number of trees in the forest.")] = 100
    leaf_size: Annotated[int, Meta(ge=1, description="Minimum number of rows in a leaf.")] = 10
    split_features: Annotated[
        float, Meta(gt=0, le=1, description="Share of the inputs tried at each split.")
    ] = 1 / 3
    components: Annotated[int, Meta(ge=0, le=4096, description=COMPONENTS)] = 58
    forest: Annotated[
        Literal["shared", "per_dof"],
        Meta(description="One forest for all degrees of freedom, or one each (the paper)."),
    ] = "shared"
    residuals: Residuals = "auto"
    forest_copies: Annotated[
        int,
        Meta(ge=0, description="Augmented copies of each frame among the forest's rows."),
    ] = 3
    hidden: Hidden = (256, 128)
    feature_noise: FeatureNoise = 0.1

    def __post_init__(self) -> None:
        """Reject quantiles that are out of range or out of order."""
        low, high = self.quantiles
        if not 0.0 < low < high < 1.0:
            raise ValueError(f"quantiles: expected 0 < low < high < 1, found {low} and {high}")


class CqrHead(ExportedHead):
    """Features -> pose (n, 7) and the forest's input; ``completed`` adds lower and upper."""

    output_names = ("pose", "forest_input")
    runtime_method = "cqr"
    rotation = "tangent_predicted"

    def __init__(
        self,
        network: PointNetwork,
        components: Tensor,
        forests: list[Forest],
        setting: Setting,
        config: CqrConfig,
    ) -> None:
        super().__init__()
        self.network = network
        self.decoder = PoseDecoder(setting.target)
        self.register_buffer("components", components)
        self.components: Tensor
        self.forests = forests
        for number, forest in enumerate(forests):
            for name in forest_fields():
                values = torch.from_numpy(getattr(forest, name))
                self.register_buffer(f"forest{number}_{name}", values)
        self._quantiles = config.quantiles
        self._method_parameters = CqrParameters(
            half_width_floor=half_width_floor(setting.target), sides="symmetric"
        )

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return pose (n, 7) in metres and the forest's input (n, components + 6 or 9)."""
        point = self.network(features)
        compressed = self.network.standardise(features) @ self.components
        pose = self.decoder.pose(self.decoder(point))
        return pose, torch.cat([compressed, point], dim=1)

    def candidates(self) -> tuple[Candidate, ...]:
        """Put the normalised score first: its factors transfer to harder or easier recordings."""
        return interval_candidates(self._method_parameters)

    def completed(self, content: bytes) -> bytes:
        """Append the forests to ``forest_input`` and output the bounds instead of it.

        lower, upper = (t_hat, 0) + quantile, in the chart centred at the prediction.
        """
        model = onnx.load_from_string(content)
        graph = model.graph
        bounds = ("lower", "upper")
        parts: dict[str, list[str]] = {name: [] for name in bounds}
        for number, forest in enumerate(self.forests):
            names = [f"forest{number}/{bound}" for bound in bounds]
            nodes, constants = quantile_nodes(
                forest, self._quantiles, "forest_input", names, f"forest{number}/"
            )
            graph.node.extend(nodes)
            graph.initializer.extend(constants)
            for bound, name in zip(bounds, names, strict=True):
                parts[bound].append(name)
        graph.initializer.extend(
            [
                numpy_helper.from_array(np.arange(DOF), "bounds/first_six"),
                numpy_helper.from_array(_ORIGIN, "bounds/origin"),
            ]
        )

        def add(kind: str, inputs: list[str], output: str, **attributes: Any) -> None:  # noqa: ANN401
            name = f"bounds/{output}_{kind}"
            graph.node.append(helper.make_node(kind, inputs, [output], name=name, **attributes))

        add("Gather", ["pose", "bounds/first_six"], "bounds/six", axis=1)
        add("Mul", ["bounds/six", "bounds/origin"], "bounds/point")
        for bound in bounds:
            add("Concat", parts[bound], f"bounds/{bound}", axis=1)
            add("Add", ["bounds/point", f"bounds/{bound}"], bound)
        kept = [output for output in graph.output if output.name != "forest_input"]
        del graph.output[:]
        graph.output.extend(kept)
        graph.output.extend(
            helper.make_tensor_value_info(bound, TensorProto.FLOAT, [1, DOF]) for bound in bounds
        )
        model.opset_import.append(helper.make_opsetid(ML_DOMAIN, ML_OPSET))
        completed: bytes = model.SerializeToString()
        return completed

    def completed_outputs(self, outputs: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """Compute the same bounds in numpy from the exported model's outputs, bit for bit."""
        pose, x = outputs["pose"], outputs["forest_input"]
        bounds = {}
        for name, tau in zip(("lower", "upper"), self._quantiles, strict=True):
            quantile = np.concatenate([f.quantiles(x, tau) for f in self.forests], axis=1)
            bounds[name] = pose[:, :DOF] * _ORIGIN + quantile
        return {"pose": pose, **bounds}


# In its own tangent chart, a prediction has its translation and zero rotation.
_ORIGIN = np.array([1, 1, 1, 0, 0, 0], dtype=np.float32)


def _train(lessons: Lessons, config: CqrConfig) -> CqrHead:
    check_components(lessons, config.components)
    setting = lessons.setting
    held_out = learn_held_out(lessons, "cqr", config.residuals, config.hidden, config.feature_noise)
    network, rows = held_out.network, held_out.rows
    features, poses = lessons.features()
    # Spread the chosen copies evenly over the grades; use all copies if there are too few.
    spread = np.linspace(0, len(features) - 1, config.forest_copies + 2)[:-1]
    copies = np.unique(spread.round().astype(int))
    features, poses = features[copies], poses[copies]
    point = held_out.points(features)
    residual = residuals_of(setting, point, poses[:, rows]).reshape(-1, DOF)
    components = principal_components(network, features[0], config.components)
    x = np.concatenate(
        [compressed(network, features[:, rows], components), point.astype(np.float32)], axis=2
    )
    scale = deviation_of(residual)
    columns = (
        [slice(0, DOF)] if config.forest == "shared" else [slice(d, d + 1) for d in range(DOF)]
    )
    forests = [
        grow(
            x.reshape(-1, x.shape[2]),
            residual[:, column],
            scale[column],
            trees=config.trees,
            leaf_size=config.leaf_size,
            share=config.split_features,
            seed=setting.seed,
        )
        for column in columns
    ]
    return CqrHead(network, components, forests, setting, config)


def _restore(setting: Setting, config: CqrConfig, state: Mapping[str, Tensor]) -> CqrHead:
    count = 1 if config.forest == "shared" else DOF
    forests = [
        Forest(**{name: state[f"forest{number}_{name}"].numpy() for name in forest_fields()})
        for number in range(count)
    ]
    size = setting.feature_size, setting.target.size
    network = PointNetwork(*size, config.hidden, config.feature_noise)
    head = CqrHead(network, state["components"], forests, setting, config)
    head.load_state_dict(state)
    return head


METHOD = Method(CqrConfig, _train, _restore, turns=True)
