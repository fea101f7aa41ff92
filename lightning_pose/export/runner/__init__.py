"""What asks an exported folder, with numpy, OpenCV and onnxruntime alone; `one_file` writes it into the folder."""
