"""A trained system as a folder that runs without torch: `graphs`, `onnx_files`, `map_files`, `agreement`, `folder`.

`runner` is what asks such a folder; `one_file` writes it, with what it uses, into the folder.
"""
