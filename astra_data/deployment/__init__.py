"""Trained policies as folders that run without this package.

graph         a policy with its encoder and memory as one ONNX graph
folder        the folder: the graph, a description, a page, a loop
page          its README
run_policy    the loop, which is copied into the folder: onnxruntime and NumPy alone
"""
