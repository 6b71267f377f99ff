"""The baseline through the same commands: trained, exported, simulated, evaluated; and refused where it differs."""

import json

import pytest
from training.runs import train_mapping

from hgn import evaluate, rollout, train
from hgn.export import export
from hgn.runtime.weights import load_weights
from hgn.schema import ConfigError

GNS = {"levels": 1, "message_passing_steps": 2, "width": 8}


def test_every_command_takes_the_baseline(data, tmp_path, capsys):
    """GNS is trained, resumed, exported, simulated and evaluated by the HGN's commands; fp16 is refused."""
    network = GNS | {"kind": "gns"}
    run = tmp_path / "run"
    for updates in (2, 4):
        mapping = train_mapping(data, run, maximum_updates=updates)
        assert train.main(mapping | {"network": network}) == 0
    with pytest.raises(ConfigError, match="precision must be tf32 or fp32 on backend torch, got fp16; triton: it"):
        train.main(train_mapping(data, tmp_path / "half", precision="fp16") | {"network": network})
    with pytest.raises(ConfigError, match=r"network\.kind must be '.*' to resume"):
        train.main(train_mapping(data, run))
    weights = tmp_path / "weights.safetensors"
    export(run / "checkpoints" / "last.ckpt", weights)
    loaded, info = load_weights(weights)
    assert type(loaded).__name__ == "GraphNetworkSimulator" and info.network.kind == "gns" and info.updates == 4
    place = {"weights": str(weights), "data": data.dataset.folder}
    out = tmp_path / "rollout.vtkhdf"
    assert rollout.main(place | {"episode": "validation-000000", "frames": 4, "out": str(out)}) == 0
    report = tmp_path / "errors.json"
    assert evaluate.main(place | {"scenes": 1, "rollout_frames": 4, "json": str(report)}) == 0
    assert capsys.readouterr().out.count("validation, 1 scene, every frame;") == 1
    assert out.is_file() and json.loads(report.read_text())["rows"][0]["one_step_mse"] > 0
