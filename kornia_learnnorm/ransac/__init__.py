"""ransac"""
