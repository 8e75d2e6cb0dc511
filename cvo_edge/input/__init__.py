"""From a source to the model's input: frames, capture, decoding, resize and frame checks."""
