"""What asks an exported folder, with numpy, OpenCV and onnxruntime alone; `one_file` makes the folder's runner of it."""
