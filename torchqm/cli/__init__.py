"""torchqm.cli"""
