"""MLServer with a custom onnxruntime runtime: Open Inference Protocol over HTTP and gRPC.

    python benchmarks/peers/mlserver_runtime.py HTTP_PORT GRPC_PORT NAME POLICY.onnx

Settings as its documentation recommends for a light model in production: no worker processes (`parallel_workers=0`,
which keeps the model in the server's own process), no debug mode, no request logs.
"""

# pyright: reportMissingImports=false
# Its library is in an environment of its own.

from __future__ import annotations

import asyncio
import sys

from mlserver import MLModel, MLServer, ModelSettings, Settings
from mlserver.codecs import NumpyCodec
from mlserver.settings import ModelParameters
from mlserver.types import InferenceRequest, InferenceResponse
from network import network


class PolicyRuntime(MLModel):  # type: ignore[misc]  # its base class is not in the type checker's environment
    async def load(self) -> bool:
        self._act = network(self.settings.parameters.uri)
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        action = self._act(NumpyCodec.decode_input(payload.inputs[0])[0])[None]
        return InferenceResponse(model_name=self.name, outputs=[NumpyCodec.encode_output("action", action)])


async def main(port: int, grpc_port: int, name: str, onnx_file: str) -> None:
    server = MLServer(
        Settings(
            debug=False,
            host="127.0.0.1",
            http_port=port,
            grpc_port=grpc_port,
            metrics_endpoint=None,
            parallel_workers=0,
            gzip_enabled=False,
        )
    )
    model = ModelSettings(name=name, implementation=PolicyRuntime, parameters=ModelParameters(uri=onnx_file))
    await server.start([model])


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:5]))
