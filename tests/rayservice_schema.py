"""Strict JSON schema of a KubeRay RayService, around Kubernetes' own pod templates.

Written for these tests after the field names of KubeRay's API types (ray.io/v1, master of late 2026, Apache-2.0); no
other key is accepted, so a misspelt one fails here and not on a cluster, where it would be dropped silently. Fields of
features that we do not use (the autoscaler, the history server, RocksDB) are left out: add them when needed.
"""

from __future__ import annotations

from typing import Any

STRING, BOOLEAN = {"type": "string"}, {"type": "boolean"}
COUNT = {"type": "integer", "minimum": 0}
STRINGS = {"type": "object", "additionalProperties": STRING}
ANYTHING = {"type": "object"}  # checked by Kubernetes' schema, see test_manifests.py


def keys(*required: str, **properties: Any) -> dict[str, Any]:
    """Return the schema of an object with these keys and no others."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def one_of(*values: str) -> dict[str, Any]:
    return {"enum": list(values)}


SECRET_KEY = keys("key", "name", key=STRING, name=STRING, optional=BOOLEAN)
CREDENTIAL = keys(value=STRING, valueFrom=keys(secretKeyRef=SECRET_KEY))
HEAD = keys(
    "template",
    "rayStartParams",  # KubeRay requires it, if only as {}
    enableIngress=BOOLEAN,
    headService=ANYTHING,
    labels=STRINGS,
    rayStartParams=STRINGS,
    resources=STRINGS,
    serviceType=one_of("ClusterIP", "NodePort", "LoadBalancer"),
    template=ANYTHING,
)
WORKERS = keys(
    "groupName",
    "maxReplicas",
    "minReplicas",
    "rayStartParams",
    "template",
    groupName=STRING,
    idleTimeoutSeconds=COUNT,
    labels=STRINGS,
    maxReplicas=COUNT,
    minReplicas=COUNT,
    numOfHosts=COUNT,
    rayStartParams=STRINGS,
    replicas=COUNT,
    resources=STRINGS,
    suspend=BOOLEAN,
    template=ANYTHING,
)
CLUSTER = keys(
    "headGroupSpec",
    authOptions=keys(mode=one_of("disabled", "token"), secretName=STRING, enableK8sTokenAuth=BOOLEAN),
    gcsFaultToleranceOptions=keys(
        backend=one_of("redis", "rocksdb"),
        externalStorageNamespace=STRING,
        redisAddress=STRING,
        redisPassword=CREDENTIAL,
        redisUsername=CREDENTIAL,
    ),
    headGroupSpec=HEAD,
    headServiceAnnotations=STRINGS,
    managedBy=STRING,
    rayVersion=STRING,
    suspend=BOOLEAN,
    tlsOptions=keys(enabled=BOOLEAN),
    upgradeStrategy=keys(type=one_of("Recreate", "None")),
    workerGroupSpecs={"type": "array", "items": WORKERS},
)
RAY_SERVICE = keys(
    "apiVersion",
    "kind",
    "metadata",
    "spec",
    apiVersion=one_of("ray.io/v1"),
    kind=one_of("RayService"),
    metadata=keys("name", name=STRING, namespace=STRING, labels=STRINGS, annotations=STRINGS),
    spec=keys(
        "rayClusterConfig",
        "serveConfigV2",
        excludeHeadPodFromServeSvc=BOOLEAN,
        managedBy=STRING,
        rayClusterConfig=CLUSTER,
        rayClusterDeletionDelaySeconds=COUNT,
        serveConfigV2=STRING,
        serveService=ANYTHING,
        suspend=BOOLEAN,
        upgradeStrategy=keys(type=one_of("NewCluster", "NewClusterWithIncrementalUpgrade", "None")),
    ),
)

# monitoring.coreos.com/v1, of the Prometheus operator: what we use of it.
POD_MONITOR = keys(
    "apiVersion",
    "kind",
    "metadata",
    "spec",
    apiVersion=one_of("monitoring.coreos.com/v1"),
    kind=one_of("PodMonitor"),
    metadata=keys("name", name=STRING, namespace=STRING, labels=STRINGS),
    spec=keys(
        "podMetricsEndpoints",
        "selector",
        selector=keys(matchLabels=STRINGS),
        podMetricsEndpoints={
            "type": "array",
            "items": keys(
                port=STRING,
                path=STRING,
                interval=STRING,
                authorization=keys("credentials", type=STRING, credentials=SECRET_KEY),
            ),
        },
    ),
)
