"""Compiled CPU kernels (to come); for now every call takes the reference path."""
def serves(module, *tensors):
    return False
