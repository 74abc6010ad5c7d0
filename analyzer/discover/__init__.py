"""The sounds that recur in a home: found, described, grouped, and named by a person."""
