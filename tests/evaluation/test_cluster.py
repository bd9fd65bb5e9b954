"""A cluster of processes gives what one process gives, whoever is killed."""

import os
import signal
import socket
import ssl
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import mfvpr
from mfvpr.evaluation import Fusion, Pipeline, System, rank_dataset
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from mfvpr.storage import FeatureCache
from mfvpr.utils import Cluster, InputError, Runtime
from tests.storage.extractors import SIFT, TwoScales

pytestmark = pytest.mark.slow

SCORERS = {"histogram": mfvpr.HistogramOfShifts(), "count": mfvpr.MatchCount()}


def assert_same(result, expected):
    for name, ranked in expected.systems.items():
        for ranking, expected_ranking in zip(result.systems[name], ranked, strict=True):
            np.testing.assert_array_equal(ranking.rows, expected_ranking.rows, err_msg=name)
            np.testing.assert_array_equal(ranking.scores, expected_ranking.scores, err_msg=name)


def die_once(flag):
    """Kill this process, if the file is there, which is removed before."""
    with suppress(FileNotFoundError):
        os.unlink(flag)
        os.kill(os.getpid(), signal.SIGKILL)


@dataclass(frozen=True)
class FatalSift(Sift):
    """Kills the first worker that describes images, or without a flag every worker; in use, it cannot be pickled."""

    flag: str | None = None
    recipe = "fatal"

    def __call__(self, images):
        self.__dict__["program"] = threading.Lock()
        die_once(self.flag) if self.flag else os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(images)


@dataclass(frozen=True)
class FatalMatcher:
    """Kills the first worker that matches."""

    flag: str
    recipe = "fatal"

    def __call__(self, features0, features1):
        die_once(self.flag)
        return mfvpr.match(features0, features1)


@pytest.fixture(scope="module")
def cluster():
    with Cluster.local(3) as started:
        yield started


@pytest.fixture
def flag(tmp_path):
    path = tmp_path / "flag"
    path.touch()
    return str(path)


def system_of(extractor=SIFT, retriever=None, **options):
    retriever = retriever or Retrieval(Aggregated(SIFT, VladFitting(num_words=8)))
    pipeline = Pipeline(extractor, retriever, candidates=4, **options)
    return System(pipeline, SCORERS, {"histogram": Fusion()})


def test_who_has_no_key_of_the_cluster_reaches_neither_scheduler_nor_workers(cluster):
    client, context = cluster._client, ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    client.wait_for_workers(3)
    workers = client.scheduler_info(n_workers=-1)["workers"]
    addresses = {client.scheduler.address, *workers, *(worker["nanny"] for worker in workers.values())}
    assert len(addresses) >= 7
    for address in addresses:
        host, port = address.removeprefix("tls://").split(":")
        assert host == "127.0.0.1"
        encrypted = context.wrap_socket(socket.create_connection((host, int(port))))
        with encrypted, pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
            encrypted.recv(1)
    port = int(str(cluster).rpartition(":")[2].partition("/")[0])
    with socket.socket() as other:
        other.bind(("127.0.0.2", port))  # free, unless the dashboard listens on all addresses


def test_workers_describe_and_match_and_results_are_those_of_one_process(dataset, cluster, tmp_path):
    extractor = TwoScales()
    system, runtime = system_of(extractor, Retrieval(extractor)), Runtime(cluster=cluster)
    result = rank_dataset(dataset, system, cache=FeatureCache(tmp_path / "store"), runtime=runtime)
    assert_same(result, rank_dataset(dataset, system, cache=FeatureCache(tmp_path / "plain")))


@pytest.mark.parametrize("stage", ["describing", "matching"])
def test_a_killed_worker_costs_time_alone(dataset, cluster, flag, tmp_path, stage):
    fatal = {"describing": {"extractor": FatalSift(max_keypoints=60, image_size=(160, 120), batch_size=3, flag=flag)},
             "matching": {"matcher": FatalMatcher(flag)}}  # fmt: skip
    vars(fatal["describing"]["extractor"])["program"] = threading.Lock()  # as after its use in this process
    cache = FeatureCache(tmp_path / "store", runtime=Runtime(cluster=cluster))
    result = rank_dataset(dataset, system_of(**fatal[stage]), cache=cache)
    assert not Path(flag).exists()
    assert_same(result, rank_dataset(dataset, system_of(), cache=FeatureCache(tmp_path / "plain")))


def test_a_block_that_kills_every_worker_ends_the_call_and_not_the_cluster(dataset, cluster, tmp_path):
    extractor = FatalSift(max_keypoints=60, image_size=(160, 120), batch_size=3)
    cache = FeatureCache(tmp_path, runtime=Runtime(cluster=cluster))
    with pytest.raises(InputError, match="cluster: 4 workers died in one block"):
        cache.local(dataset.database, extractor)
    [features] = cache.local(dataset.database, SIFT)
    assert (features.counts > 0).all()


def test_a_cluster_needs_a_folder(dataset, cluster):
    with pytest.raises(InputError, match="cluster: expected a cache with a root"):
        rank_dataset(dataset, system_of(), runtime=Runtime(cluster=cluster))
