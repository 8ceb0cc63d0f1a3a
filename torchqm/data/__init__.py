"""torchqm.data"""
