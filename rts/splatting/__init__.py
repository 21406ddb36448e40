"""The splatters in array-API code: the specification of the method, for any engine and device.

The splatters registered by name (`rts_backends.fused`) inherit from these and run compiled loops on the host.
"""

from rts.splatting.kernel import Kernel, exact_calibration
from rts.splatting.single_and_multi import Multi, Plain, Single
from rts.splatting.visible import Visible

__all__ = ["Kernel", "Multi", "Plain", "Single", "Visible", "exact_calibration"]
