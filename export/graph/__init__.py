"""Torch graph of a whole policy, written as ONNX and TorchScript."""
