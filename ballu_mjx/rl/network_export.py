"""Export of a trained network from JAX: as named arrays for NumPy, and as an ONNX graph."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.rl.mirror import OFFSET, Mirror, even_moments, unfold_layers
from ballu_mjx.rl.ppo import STATE, Params, PPOConfig


class NetworkPort(NamedTuple):
    """An input or output of an ONNX graph (float32, shape [batch, len(names)])."""

    name: str
    names: Sequence[str]
    """Name and unit of each number, in order, separated by a comma."""


class OutputScale(NamedTuple):
    """Scaling of a network's output to physical units: `clip(scale * output + shift, low, high)`."""

    scale: Float[np.ndarray, " outputs"]
    shift: Float[np.ndarray, " outputs"]
    low: Float[np.ndarray, " outputs"]
    high: Float[np.ndarray, " outputs"]


def network_arrays(params: Params, config: PPOConfig, mirror: Mirror | None = None) -> dict[str, np.ndarray]:
    """Return a policy's network as arrays by name. A symmetric network with `mirror` becomes a plain one.

    The names are `mean`, `std`, `observation_clip`, `activation`, and `kernel_0`, `bias_0` and so on for each layer.
    The output of the last layer is the mean of the policy's Gaussian, which is also its mode. The standard deviation is
    a separate parameter and is left out.
    """
    mean, std = (np.asarray(moment[STATE]) for moment in (params.normalizer.mean, params.normalizer.std))
    clip = config.observation_clip
    if not config.normalize_observations:
        mean, std, clip = np.zeros_like(mean), np.ones_like(std), math.inf
    layers = _layers(params.policy["params"])
    if mirror is not None:
        mean, std = (np.asarray(moment) for moment in even_moments(mean, std, mirror.observation))
        layers = unfold_layers(layers, np.asarray(params.policy["params"][OFFSET]), mirror)
    return {
        "mean": mean,
        "std": std,
        "observation_clip": np.array(clip, float),
        "activation": np.array(config.activation),
        **{f"kernel_{i}": kernel for i, (kernel, _) in enumerate(layers)},
        **{f"bias_{i}": bias for i, (_, bias) in enumerate(layers)},
    }


def check_onnx() -> None:
    """Check that the package onnx is installed.

    **Raises** `InputError` if it is not.
    """
    if importlib.util.find_spec("onnx") is None:
        raise InputError(
            '--onnx: the package onnx is not installed; install it by `pip install -c constraints.txt -e ".[onnx]"`.'
        )


def onnx_model(
    stored: Mapping[str, np.ndarray], source: NetworkPort, target: NetworkPort, output: OutputScale, title: str
) -> bytes:
    """Return the serialized ONNX model of a network with input `source` and output `target`.

    `stored` is the result of `network_arrays`. The model's properties `inputs` and `outputs` hold the names and units
    of both as JSON lists.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def node(kind: str, inputs: list[str], name: str) -> str:
        nodes.append(helper.make_node(kind, inputs, [name]))
        return name

    x = node("Sub", [source.name, constant("mean", stored["mean"])], "centred")
    x = node("Div", [x, constant("std", stored["std"])], "normalized")
    clip = float(stored["observation_clip"])
    if math.isfinite(clip):
        x = node("Clip", [x, constant("lowest", -clip), constant("highest", clip)], "clipped")
    last = sum(name.startswith("kernel_") for name in stored) - 1
    for i in range(last + 1):
        kernel, bias = (constant(name, stored[name]) for name in (f"kernel_{i}", f"bias_{i}"))
        x = node("Gemm", [x, kernel, bias], f"layer_{i}")
        if i < last and str(stored["activation"]) == "swish":
            x = node("Mul", [x, node("Sigmoid", [x], f"gate_{i}")], f"active_{i}")
        elif i < last:
            x = node("Tanh", [x], f"active_{i}")
    x = node("Mul", [x, constant("scale", output.scale)], "scaled")
    x = node("Add", [x, constant("shift", output.shift)], "shifted")
    x = node("Max", [x, constant("low", output.low)], "raised")
    node("Min", [x, constant("high", output.high)], target.name)
    ends = [
        helper.make_tensor_value_info(port.name, TensorProto.FLOAT, ["batch", len(port.names)], ", ".join(port.names))
        for port in (source, target)
    ]
    graph = helper.make_graph(nodes, title, ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    described = {"inputs": json.dumps(list(source.names)), "outputs": json.dumps(list(target.names))}
    helper.set_model_props(model, described)
    checker.check_model(model)
    return model.SerializeToString()


def _layers(tree: Mapping) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return kernel and bias of each layer of Brax's policy network, `PolicyModuleWithStd`."""
    hidden = tree["MLP_0"]
    assert set(tree) - {OFFSET} == {"MLP_0", "Dense_0", "std_logparam"}, set(tree)
    assert set(hidden) == {f"hidden_{i}" for i in range(len(hidden))}, set(hidden)
    layers = [hidden[f"hidden_{i}"] for i in range(len(hidden))] + [tree["Dense_0"]]
    return [(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers]
