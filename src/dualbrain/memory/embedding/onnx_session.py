"""Sessions of ONNX Runtime for the encoders."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError


def open_session(model: bytes, external_data: Mapping[str, bytes] | None = None) -> Any:
    """An ONNX Runtime session with one thread, so that the encoder does not take cores from the control loop.

    `external_data` maps the names of the files to which tensors of `model` refer to their contents. Raises
    `MissingDependencyError` if onnxruntime is not installed.
    """
    try:
        runtime: Any = import_module("onnxruntime")
    except ImportError as error:
        raise MissingDependencyError(
            "The package onnxruntime", fix="Install it with `pip install 'dualbrain[memory]'`."
        ) from error
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    if external_data:
        names, contents = list(external_data), list(external_data.values())
        options.add_external_initializers_from_files_in_memory(names, contents, [len(data) for data in contents])
    return runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
