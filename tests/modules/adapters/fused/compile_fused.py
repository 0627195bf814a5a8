"""Compiles the fused kernels for Hopper with the options they are launched with, without a GPU; prints as JSON what
each kernel takes.

A program of its own: in the tests' process Triton only interprets. python compile_fused.py HIDDEN
"""

import importlib
import inspect
import json
import sys

import torch
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile

from mosa.modules.adapters.fused.operation import LANES, _Launch

FORWARD = ("phi_forward", "psi1_forward", "psi2_forward", "theta_forward")
BACKWARD = ("phi_backward", "psi1_backward", "psi2_backward", "theta_backward")
BETWEEN = ("assemble", "assemble_adjoint", "normals", "normals_adjoint", "finish")
FLAGS = {"BOUNDED": True, "EXTRA": False, "RESTED": True, "OPERATOR": True, "D": 1.0}
INTEGERS, FLOATS = ("N", "M", "start", "size"), ("scale", "bound", "alpha")


def compiled(module: str, name: str, options: dict) -> dict:
    function = getattr(importlib.import_module(f"mosa.modules.adapters.fused.{module}"), name)
    values = FLAGS | options
    signature, constants, divisible = {}, {}, {}
    for place, argument in enumerate(inspect.signature(function.fn).parameters):
        if argument in values:
            signature[argument], constants[(place,)] = "constexpr", values[argument]
        elif argument in INTEGERS or argument in FLOATS:
            signature[argument] = "i32" if argument in INTEGERS else "fp32"
        else:
            signature[argument] = "*fp32"
        if argument == "M" or signature[argument].startswith("*"):
            divisible[(place,)] = [["tt.divisibility", 16]]
    launch = {key: options[key] for key in ("num_warps", "num_stages", "maxnreg") if key in options}
    source = ASTSource(fn=function, signature=signature, constexprs=constants, attrs=divisible)
    kernel = compile(source, target=GPUTarget("cuda", 90, 32), options=launch)
    return {
        "shared": kernel.metadata.shared,
        "tensor_cores": "wgmma" in kernel.asm["ptx"] or "mma.sync" in kernel.asm["ptx"],
    }


def main(hidden: int) -> None:
    launch = _Launch(1000, hidden, torch.device("cpu"))
    found = {name: compiled("network_kernels", name, launch.forward) for name in FORWARD}
    options = launch.size | {"WANTED": True}
    found |= {name: compiled("adjoint_kernels", name, options) for name in BACKWARD}
    found |= {
        name: compiled("assembly_kernels", name, {"BLOCK": LANES, "num_warps": 4})
        for name in BETWEEN
    }
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
