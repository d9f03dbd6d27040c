"""`[misalignment]` and `[random.misalignment]`: the deviations of the true rig, with names and ranges of `scenes`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field, create_model

from phibench.datasets.distribution import Distribution
from phibench.datasets.recipe_table import Table
from phibench.scenes.misalignment import PARAMETERS

if TYPE_CHECKING:
    MisalignmentTable = Table
    RandomMisalignmentTable = Table
else:
    MisalignmentTable = create_model(
        "MisalignmentTable",
        __base__=Table,
        __doc__="`[misalignment]`: what the true rig deviates by from `[rig]`, which is the nominal one.",
        **{
            key: (float, Field(default=0.0, ge=-one.limit, le=one.limit, description=one.meaning))
            for key, one in PARAMETERS.items()
        },
    )
    RandomMisalignmentTable = create_model(
        "RandomMisalignmentTable",
        __base__=Table,
        __doc__="`[random.misalignment]`: distributions of keys of `[misalignment]`.",
        **{key: (Distribution | None, Field(default=None, description=one.meaning)) for key, one in PARAMETERS.items()},
    )
