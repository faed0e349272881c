"""Methods of the Open Inference Protocol, registered and answered."""

from __future__ import annotations

from rlservo.serve_app.protocols import oip_grpc
from rlservo.serve_app.ray_serve import grpc_ingress


def test_every_method_that_is_answered_is_registered_with_serve() -> None:
    """Two lists: what Serve's proxies import needs nothing but grpcio."""
    assert {*grpc_ingress.UNARY} == {*oip_grpc.METHODS, "ModelInfer"}
    assert grpc_ingress.STREAMS == ("ModelStreamInfer",)
    assert all(hasattr(oip_grpc.InferenceService, name) for name in (*grpc_ingress.UNARY, *grpc_ingress.STREAMS))
