"""ONNX graphs: export from torch and 8-bit quantisation."""
