"""Source of a given ONNX file: its tensors, and what its metadata and the files beside it say of them."""
