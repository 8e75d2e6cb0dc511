"""The ONNX graph: export from torch, and 8-bit quantisation."""
