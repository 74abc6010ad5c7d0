"""Measurements behind the pages of docs/, and what developers run: no part of the product."""
