"""The Kubernetes files: valid by published schemas, and what they start is what the commands accept.

Schemas: Kubernetes' own objects by the OpenAPI schemas in kubernetes-validate; TrainJob and its runtime by Kubeflow's
published types (kubeflow-trainer-api). KubeRay and Kueue publish no Python types: the keys below are those of the
definitions ray.io_rayjobs.yaml (version v1) in ray-project/kuberay and kueue.x-k8s.io_*.yaml (v1beta2) in
kubernetes-sigs/kueue, and the pods in them are Kubernetes' own.
"""

import re
import shlex
import tomllib
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from datagen.generate import datagen_config
from datagen.service.__main__ import ServiceConfig
from datagen.service.server import _GRACE_S
from datagen.service.supervisor import _STOP_PATIENCE_S
from hgn.config import TrainConfig
from hgn.data.storage import TOKEN_VARIABLE
from hgn.schema import from_mapping

K8S = Path(__file__).resolve().parents[2] / "jobs" / "k8s"
OLDEST, NEWEST = "1.31", "1.37"
SERVICE_KEYS = ("host", "port", "health_port")
# keys of each part of a RayJob; + stands before those that must be there
RAY = {
    "": "+apiVersion +kind +metadata +spec",
    "spec": """activeDeadlineSeconds backoffLimit clusterSelector deletionStrategy entrypoint jobId entrypointNumCpus
        entrypointNumGpus entrypointResources managedBy metadata rayClusterSpec preRunningDeadlineSeconds runtimeEnvYAML
        shutdownAfterJobFinishes submissionMode submitterConfig submitterPodTemplate suspend ttlSecondsAfterFinished""",
    "cluster": """authOptions autoscalerOptions enableInTreeAutoscaling gcsFaultToleranceOptions +headGroupSpec
        headServiceAnnotations managedBy networkPolicy rayVersion suspend tlsOptions upgradeStrategy
        workerGroupSpecs""",
    "head": "enableIngress headService labels rayStartParams resources serviceType +template",
    "worker": """+groupName idleTimeoutSeconds labels +maxReplicas +minReplicas numOfHosts rayStartParams replicas
        resources scaleStrategy suspend +template""",
}


def documents(name):
    return list(yaml.safe_load_all((K8S / name).read_text()))


def validate_pod(template):
    document = {"apiVersion": "v1", "kind": "PodTemplate", "metadata": {"name": "checked"}, "template": template}
    for version in (OLDEST, NEWEST):
        kubernetes_validate.validate(document, version, strict=True)


def containers():
    """Every container of every file, and the trainer of the TrainJob."""
    (ray_job,) = documents("generate.yaml")
    cluster = ray_job["spec"]["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    pods = [group["template"] for group in groups] + [documents("service.yaml")[0]["spec"]["template"]]
    found = [container for pod in pods for container in pod["spec"]["containers"]]
    return [*found, documents("train.yaml")[0]["spec"]["trainer"]]


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
@pytest.mark.parametrize("name", ["service.yaml", "volume.yaml"])
def test_objects_of_kubernetes(name, version):
    """Deployment, service and volume claim are valid by the published schemas, without an unknown key."""
    for document in documents(name):
        kubernetes_validate.validate(document, version, strict=True)
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(document | {"colour": 1}, version, strict=True)


def test_train_job():
    """TrainJob and runtime are such by Kubeflow's types, which know each of their keys: they come back unchanged."""
    from kubeflow_trainer_api import models  # a second of one core in each process that only collects tests

    (job,), (runtime,) = documents("train.yaml"), documents("runtime.yaml")
    kinds = (models.TrainerV1alpha1TrainJob, models.TrainerV1alpha1ClusterTrainingRuntime)
    for kind, document in zip(kinds, (job, runtime), strict=True):
        typed = kind.from_dict(document)
        assert typed is not None and typed.to_dict() == document
    trainer, reference = job["spec"]["trainer"], job["spec"]["runtimeRef"]
    assert (reference["kind"], reference["name"]) == (runtime["kind"], runtime["metadata"]["name"])
    assert trainer["resourcesPerNode"]["limits"]["nvidia.com/gpu"] == str(trainer["numProcPerNode"])
    (node,) = runtime["spec"]["template"]["spec"]["replicatedJobs"]
    assert node["template"]["metadata"]["labels"] == {"trainer.kubeflow.org/trainjob-ancestor-step": "trainer"}
    pod = node["template"]["spec"]["template"]
    (container,) = pod["spec"]["containers"]
    assert container["name"] == "node" and container["image"] == trainer["image"]  # Trainer finds it by this name
    whole = container | {"image": trainer["image"], "env": trainer["env"], "args": trainer["args"]}
    validate_pod({"spec": pod["spec"] | {"containers": [whole | {"resources": trainer["resourcesPerNode"]}]}})
    timeout = next(e["value"] for e in trainer["env"] if e["name"] == "TORCH_ELASTIC_SHUTDOWN_TIMEOUT")
    assert pod["spec"]["terminationGracePeriodSeconds"] > int(timeout)


def test_ray_job():
    """The RayJob has only keys of its definition, those that must be there, and valid pods."""
    (job,) = documents("generate.yaml")
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    cluster = job["spec"]["rayClusterSpec"]
    groups = [("head", cluster["headGroupSpec"]), *(("worker", group) for group in cluster["workerGroupSpecs"])]
    for part, keys in (("", job), ("spec", job["spec"]), ("cluster", cluster), *groups):
        words = RAY[part].split()
        assert {word[1:] for word in words if word[0] == "+"} <= set(keys) <= {word.lstrip("+") for word in words}
    for part, group in groups:
        validate_pod(group["template"])
        assert all(isinstance(value, str) for value in group.get("rayStartParams", {}).values())
        assert part == "head" or group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]


def test_queue():
    """Kueue's objects name each other and cover what the jobs request, which wait in the queue; a RayJob that can be
    suspended ends its cluster (a rule of Kueue)."""
    flavor, cluster, local = documents("queue.yaml")
    kinds = [(each["apiVersion"], each["kind"]) for each in (flavor, cluster, local)]
    assert kinds == [("kueue.x-k8s.io/v1beta2", kind) for kind in ("ResourceFlavor", "ClusterQueue", "LocalQueue")]
    (group,) = cluster["spec"].pop("resourceGroups")
    assert cluster["spec"] == {"namespaceSelector": {}, "preemption": {"withinClusterQueue": "LowerPriority"}}
    names = [resource["name"] for resource in group["flavors"][0]["resources"] if int(resource["nominalQuota"][:2])]
    assert names == group["coveredResources"] == ["cpu", "memory", "nvidia.com/gpu"]
    assert group["flavors"][0]["name"] == flavor["metadata"]["name"]
    assert local["spec"] == {"clusterQueue": cluster["metadata"]["name"]}
    for job in (*documents("train.yaml"), *documents("generate.yaml")):
        assert job["metadata"]["labels"] == {"kueue.x-k8s.io/queue-name": local["metadata"]["name"]}
        assert job["kind"] != "RayJob" or job["spec"]["shutdownAfterJobFinishes"]


def test_commands_take_what_the_files_give_them(composed):
    """Each file's arguments compose to a valid configuration of the command that it starts."""
    arguments = documents("train.yaml")[0]["spec"]["trainer"]["args"]
    mapping = composed("train", arguments[arguments.index("hgn.train") + 1 :])
    mapping.pop("name")
    assert from_mapping(TrainConfig, mapping | {"run": "runs/any"}).dataset.folder == "/shared/data/obstacles"

    entrypoint = shlex.split(documents("generate.yaml")[0]["spec"]["entrypoint"])
    assert entrypoint[:3] == ["python", "-m", "datagen"]
    config = datagen_config(composed("datagen", entrypoint[3:]))
    assert (config.dataset.pool, config.dataset.folder) == ("ray", "/shared/data/obstacles")

    (container,) = documents("service.yaml")[0]["spec"]["template"]["spec"]["containers"]
    assert container["command"] == ["python", "-m", "datagen.service"]
    mapping = composed("service", container["args"])
    assert datagen_config(mapping, SERVICE_KEYS).dataset.folder == "/shared/data/obstacles"
    service = from_mapping(ServiceConfig, {key: mapping[key] for key in SERVICE_KEYS})
    assert [port["containerPort"] for port in container["ports"]] == [service.port, service.health_port]
    trainer = documents("train.yaml")[0]["spec"]["trainer"]
    assert container["env"][0]["name"] == TOKEN_VARIABLE == trainer["env"][-1]["name"]


def test_files_fit_each_other():
    """All files use one image, one claim, one secret and one port. Each name in a file is defined in another one, or
    the notes explain how to create it."""
    assert len({container["image"] for container in containers()}) == 1
    text = "\n".join(path.read_text() for path in K8S.glob("*.yaml"))
    claims = set(re.findall(r"claimName: (\S+)", text))
    assert claims == {documents("volume.yaml")[0]["metadata"]["name"]}
    deployment, service, policy = documents("service.yaml")
    assert policy["spec"]["podSelector"]["matchLabels"] == service["spec"]["selector"]
    pod = deployment["spec"]["template"]
    assert service["spec"]["selector"] == pod["metadata"]["labels"] == deployment["spec"]["selector"]["matchLabels"]
    address = f"http://{service['metadata']['name']}:{service['spec']['ports'][0]['port']}"
    assert f"dataset.folder={address}" in (K8S / "train.yaml").read_text()
    secrets = {
        (entry["valueFrom"]["secretKeyRef"]["name"], entry["valueFrom"]["secretKeyRef"]["key"])
        for container in containers()
        for entry in container.get("env", [])
        if "valueFrom" in entry
    }
    assert secrets == {("hgn-dataset", "token")}
    assert "kubectl create secret generic hgn-dataset --from-literal=token=" in text


def test_pods_are_bounded_and_not_root():
    """No tag that changes, a limit of memory, no root, no privileges: what the policy "restricted" lets in; probes that
    wait longer than a second; and as much time to end as the service takes."""
    image = (K8S / "Dockerfile").read_text()
    assert re.search(r"USER (\d+)", image)[1] == "1000" and " wget " in image  # KubeRay's probes call it
    for container in containers():
        assert not container["image"].endswith(":latest")
        assert (container.get("resources") or container["resourcesPerNode"])["limits"]["memory"]
    text = "\n".join(path.read_text() for path in K8S.glob("*.yaml"))
    pods = text.count(" containers:\n")
    assert pods == text.count("runAsNonRoot: true") == text.count("drop: [ALL]") == text.count("fsGroup: 1000") == 4
    pod = documents("service.yaml")[0]["spec"]["template"]["spec"]
    assert pod["terminationGracePeriodSeconds"] >= _STOP_PATIENCE_S + _GRACE_S
    assert all(pod["containers"][0][f"{kind}Probe"]["timeoutSeconds"] >= 5 for kind in ("readiness", "liveness"))
    extras = tomllib.loads((K8S.parents[1] / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert extras["ray"][0].startswith("ray[default]")  # without its dashboard a RayJob is refused
