"""Models that the page cannot sample are refused before export."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from pipeline.behavior.model import Architecture
from pipeline.core.errors import InputError
from stages.export_simulator import reading


@pytest.mark.parametrize("variant", [{"family": "gaussian"}, {"family": "one_stage"}, {"ego": "world"}])
def test_unsupported_model_variants_are_refused(tmp_path: Path, variant: dict[str, str]) -> None:
    (tmp_path / "behavior.json").write_text(
        json.dumps({"architecture": asdict(Architecture(bones=3, **variant))})
    )
    with pytest.raises(InputError, match=f"EXP-002.*{next(iter(variant.values()))}"):
        reading.behavior_assets(tmp_path, tmp_path, np.zeros((0, 3)))
