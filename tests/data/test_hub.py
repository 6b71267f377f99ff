"""Weights and data sets of the Hugging Face Hub, from a stand-in that speaks its protocol."""

import os
import shutil
import time

import huggingface_hub
import numpy as np
import pytest
import torch
from data import hub_server
from data.hub_server import TOKEN, served
from data.test_http import answering, refusing
from network.states import network_of

from hgn import card
from hgn.data.reader import EpisodeStore
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, save_weights
from hgn.schema import ConfigError
from hgn.system.hub import HubPlace, hub_weights


@pytest.fixture
def hub(tmp_path, cache, monkeypatch):
    network = network_of(torch.float32)
    info = WeightsInfo(network.config, 60.0, 1 / 64)
    models = tmp_path / "hub" / "models" / "one"
    for place in ("net/net", "two/a", "two/b", "private/x"):
        (models / place).parent.mkdir(parents=True, exist_ok=True)
        save_weights(models / f"{place}.safetensors", network, info)
    (models / "none").mkdir()
    (models / "none" / "README.md").write_text("nothing")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub_cache"))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.setenv(name, "")  # so that it is as before after the test, though reading sets it
    hub_weights.cache_clear()
    with served(tmp_path / "hub") as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


@pytest.mark.parametrize(
    "url", ["hf://one/net", "hf://one/net/net.safetensors", "hf://one/net@main", "hf://one/two/b.safetensors"]
)
def test_weights_come_from_a_repository(url, hub):
    """Weights are read by the file's name, or without a name if the repository has only one file. Their content is the
    file's, and a second read downloads nothing."""
    path = find_weights(url)
    place = HubPlace.parse(url, "weights")
    stored = hub.folder / "models" / place.repository / path.name
    assert path.read_bytes() == stored.read_bytes() and load_weights(path)[1].frame_rate_hz == 60.0
    asked = len(hub.asked)
    assert find_weights(url) == path and len(hub.asked) == asked


@pytest.mark.parametrize(
    ("proxy", "message"),
    [
        ("http://127.0.0.1:1", None),  # nobody listens there
        *((proxy, "proxies of the environment must be") for proxy in ("socks5://127.0.0.1:1", "ftp://a", '"http://a"')),
    ],
)
def test_proxies(hub, monkeypatch, proxy, message):
    """A hub of this machine is read without a proxy, and proxies of another kind are refused in a line."""
    monkeypatch.setenv("HTTP_PROXY", "")
    monkeypatch.setenv("http_proxy", proxy)
    huggingface_hub.close_session()
    if message is None:
        assert find_weights("hf://one/net").is_file()
    else:
        with pytest.raises(ConfigError, match=message):
            find_weights("hf://one/net")
    huggingface_hub.close_session()


@pytest.mark.parametrize(("scheme", "status"), [("http", 407), ("https", 407), ("https", 403)])
def test_proxies_that_refuse_are_named(hub, monkeypatch, scheme, status):
    """A proxy's own answer is not that of the Hub, and is not waited out."""
    with answering(refusing(status)) as address:
        monkeypatch.setenv("HF_ENDPOINT", f"{scheme}://data.example")
        monkeypatch.setenv(f"{scheme}_proxy", address)
        huggingface_hub.close_session()
        with pytest.raises(
            ConfigError, match=f"weights must be accessible through the proxy of .*, got its answer .*{status}"
        ):
            hub_weights("hf://one/net")
    huggingface_hub.close_session()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("hf://one", r"weights must be an address of the form hf://.* got 'hf://one'"),
        ("hf://datasets/one/data", r"weights must be the address of a repository of weights, hf://USER/NAME"),
        ("hf://one/two", r"weights must name one of a.safetensors, b.safetensors, got 'hf://one/two'"),
        ("hf://one/none", r"weights must name a repository with a .safetensors file"),
        ("hf://one/absent", r"weights must be accessible, got hf://one/absent refused or .*HF_TOKEN"),
        ("hf://one/net/other.safetensors", r"weights must be a file of the repository, got .*has no such file"),
        ("hf://one/private/x.safetensors", r"weights must be accessible"),
    ],
)
def test_what_cannot_be_had_is_told(url, message, hub):
    """The address, the repository or the file at fault is named."""
    with pytest.raises(ConfigError, match=message):
        find_weights(url)


def test_a_server_that_fails_is_asked_again(hub, monkeypatch):
    """Its errors are huggingface_hub's own and no OSError of a socket; one that stays away ends in a message. A token
    opens private repositories."""
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr("time.sleep", lambda _: None)  # huggingface_hub's own pauses too
    for name in ("hf://one/net/net.safetensors", "hf://one/private/x.safetensors"):
        hub.failures = 2
        assert find_weights(name).is_file()
    hub.failures = 1_000_000
    with pytest.raises(ConfigError, match=r"weights must be reachable, got no answer from .* for hf://one/two/a"):
        hub_weights("hf://one/two/a.safetensors", patience_s=0.05)


def test_a_repository_that_answers_too_slowly(hub, monkeypatch):
    """huggingface_hub itself would wait for a server that drips as long as it sends anything."""
    answer = hub_server._Handler._answer
    monkeypatch.setattr(hub_server._Handler, "_answer", lambda *given: time.sleep(0.5) or answer(*given))
    monkeypatch.setattr("hgn.system.hub._DOWNLOAD_S", 0.1)
    with pytest.raises(ConfigError, match=r"weights must be reachable.*TimeoutError"):
        hub_weights("hf://one/two/b.safetensors", patience_s=0.0)


def test_a_data_set_is_read_from_a_repository(hub, folder, monkeypatch):
    """dataset.folder=hf://datasets/…: the episodes are the folder's, with errors on the way, in a folder of it too."""
    for place in ("one/data", "one/several/part", "one/private"):
        shutil.copytree(folder, hub.folder / "datasets" / place)
    hub.failures = 2
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    for url in ("hf://datasets/one/data", "hf://datasets/one/several@main/part", "hf://datasets/one/private"):
        remote, local = EpisodeStore(url, "train"), EpisodeStore(folder, "train")
        assert len(remote) == len(local) == 5
        for left, right in zip(remote, local, strict=True):
            assert np.array_equal(left.position_TN3, right.position_TN3)
    assert not EpisodeStore.available("hf://datasets/one/nothing")
    with pytest.raises(ConfigError, match=r"dataset.folder must be an address of the form hf://"):
        EpisodeStore("hf://data", "train")


def test_cards_are_the_hubs(hub, folder):
    """Metadata that huggingface_hub itself reads and finds valid, figures of the file and the manifest, no second
    card; and what lies in such a folder is read back by its hf:// address."""
    from huggingface_hub import DatasetCard, ModelCard

    assert card.main({"data": str(folder), "license": "cc-by-4.0"}) == 0
    found = DatasetCard.load(folder / "README.md")
    assert found.data.license == "cc-by-4.0" and found.data.size_categories == ["n<1K"]
    files = found.data.to_dict()["configs"][0]["data_files"]
    assert {entry["split"] for entry in files} == {"train", "validation", "test"}
    assert all(list(folder.glob(entry["path"])) for entry in files) and "5 episodes" in found.text
    weights = hub.folder / "models" / "one" / "net" / "net.safetensors"
    target = hub.folder / "models" / "one" / "carded"
    assert card.main({"weights": str(weights), "out": str(target)}) == 0
    model = ModelCard.load(target / "README.md")
    assert model.data.library_name == "hgn" and "width 16" in model.text
    assert load_weights(find_weights("hf://one/carded"))[1].frame_rate_hz == 60.0
    with pytest.raises(ConfigError, match=r"data must be a folder without README.md"):
        card.main({"data": str(folder)})


def test_a_card_is_of_the_weights_beside_it(hub, tmp_path):
    """A different file with the name of the weights, for example an older or a cut one, is not taken for a copy, and no
    card is written next to it."""
    weights = hub.folder / "models" / "one" / "net" / "net.safetensors"
    folder = tmp_path / "folder"
    folder.mkdir()
    for make in (os.mkfifo, lambda path: path.write_bytes(weights.read_bytes()[:100])):
        (folder / "net.safetensors").unlink(missing_ok=True)
        make(folder / "net.safetensors")
        with pytest.raises(ConfigError, match=r"out must be a folder without another net\.safetensors"):
            card.main({"weights": str(weights), "out": str(folder)})
    assert [path.name for path in folder.iterdir()] == ["net.safetensors"]
    (folder / "net.safetensors").write_bytes(weights.read_bytes())
    assert card.main({"weights": str(weights), "out": str(folder)}) == 0
