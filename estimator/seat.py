"""Old name of `phibench.estimator.interface`, kept for one version: method files import `phibench.estimator.seat.pair`.

Python imports this module before its part `pair`, and then finds the part in `sys.modules`.
"""

import sys
import warnings

from phibench.estimator import interface

warnings.warn(
    "phibench.estimator.seat.pair is now phibench.estimator.interface: write `from phibench import Answer, Pair, "
    "Spot`; the old name goes with the next version",
    DeprecationWarning,
    stacklevel=2,
)
sys.modules[f"{__name__}.pair"] = interface
