"""MediaPipe's face mesh as ONNX; never imported by a command."""
