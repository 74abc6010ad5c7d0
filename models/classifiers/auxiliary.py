"""What is known of sound besides its features: directions, and embeddings."""

from typing import NamedTuple

from hearthlog.models.classifiers.directions import NOWHERE, Directions
from hearthlog.models.embedding.embeddings import NO_EMBEDDINGS, Embeddings


class Auxiliary(NamedTuple):
    """Directions of an array and embeddings of a network, of one stream of frames."""

    directions: Directions = NOWHERE
    embeddings: Embeddings = NO_EMBEDDINGS

    def known_at(self, first: int, count: int) -> "Auxiliary":
        """Return those that become known with some successive frames."""
        return Auxiliary(
            self.directions.known_at(first, count), self.embeddings.known_at(first, count)
        )

    def followed_by(self, later: "Auxiliary") -> "Auxiliary":
        """Join these with those that follow."""
        return Auxiliary(
            self.directions.followed_by(later.directions),
            self.embeddings.followed_by(later.embeddings),
        )


NO_AUXILIARY = Auxiliary()
