"""Functional mock-up units (FMUs) of FMI 2.0 and 3.0: read, simulated in worker processes, and exported.

Load only FMUs you trust: their machine code runs on this computer. It runs in processes of its own, which contains
crashes, hangs and leaks, not malice.
"""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.fmu.capabilities import Capabilities, read_capabilities, tested_capabilities
    from hvdc_ident.fmu.compile import compile_fmu
    from hvdc_ident.fmu.description import INTERFACES, Description, read_description
    from hvdc_ident.fmu.evaluate import at_point, smooth_inputs
    from hvdc_ident.fmu.model import FmuModel, FmuState, read_fmu
    from hvdc_ident.fmu.request import FmuPoint
    from hvdc_ident.fmu.worker_pool import Limits
else:
    __getattr__ = offered(
        __name__,
        {
            "capabilities": "Capabilities read_capabilities tested_capabilities",
            "compile": "compile_fmu",
            "description": "INTERFACES Description read_description",
            "evaluate": "at_point smooth_inputs",
            "model": "FmuModel FmuState read_fmu",
            "request": "FmuPoint",
            "worker_pool": "Limits",
        },
    )

__all__ = [
    "INTERFACES",
    "Capabilities",
    "Description",
    "FmuModel",
    "FmuPoint",
    "FmuState",
    "Limits",
    "at_point",
    "compile_fmu",
    "read_capabilities",
    "read_description",
    "read_fmu",
    "smooth_inputs",
    "tested_capabilities",
]
