"""reranking"""
