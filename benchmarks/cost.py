"""What the reward transformer costs: the floating point operations of its matrix products.

A multiplication counts as two operations, as usual. The count has only the needs of the
algorithm: attention to the tokens that a token may see, and in the last layer only the tokens that
are read. The rest (softmax, norms, dropout) is linear in the activations and left out. At the rate
of matrix products this gives the least time that a pass can take, its floor.
"""

from dataclasses import dataclass

from codetr_ros.config import CodetrSettings


@dataclass(frozen=True)
class Cost:
    """Floating point operations of one batch of windows.

    Args:
        settings: the architecture.
        observation_size: O.
        action_size: A.
        windows: B.
        steps: L, of each window.
        plain: count a plainly written network: all tokens go through all layers, and products
            with tokens are masked afterwards.
    """

    settings: CodetrSettings
    observation_size: int
    action_size: int
    windows: int
    steps: int
    plain: bool = False

    @property
    def forward(self) -> int:
        """Operations of labelling the windows."""
        return self._inputs + self._products

    @property
    def gradient(self) -> int:
        """Operations of a gradient step: each product forward gives two backward, except that the
        gradients of observations and actions are not needed.
        """
        return 2 * self._inputs + 3 * self._products

    @property
    def unseen(self) -> int:
        """Extra operations of a forward pass that masks tokens instead of leaving them out."""
        tokens, last = self._tokens
        every = (self.settings.layers - 1) * tokens**2 + last * tokens
        return 4 * self.windows * self.settings.embedding * (every - self._seen)

    @property
    def _tokens(self) -> tuple[int, int]:
        """Tokens of a window, and tokens that the last layer makes: one for each step."""
        tokens = self.steps * (2 if self.settings.tokens == 'pair' else 1)
        return tokens, tokens if self.plain else self.steps

    @property
    def _seen(self) -> int:
        """Pairs of a token and a token that it sees, in all layers of one window."""
        tokens, _ = self._tokens
        if self.plain:
            return self.settings.layers * tokens**2
        triangle = tokens * (tokens + 1) // 2
        last = self.steps * (self.steps + 1) if self.settings.tokens == 'pair' else triangle
        return (self.settings.layers - 1) * triangle + last

    @property
    def _inputs(self) -> int:
        rows = self.windows * self.steps
        return 2 * rows * (self.observation_size + self.action_size) * self.settings.embedding

    @property
    def _products(self) -> int:
        d, layers = self.settings.embedding, self.settings.layers
        tokens, last = self._tokens
        # of width d to d: key and value of each token; query, output and MLP of those needed
        squares = layers * 2 * tokens + 10 * ((layers - 1) * tokens + last)
        attention = 2 * d * self._seen
        head = self.steps * d  # the reward
        if self.settings.weights == 'attention':
            squares += 2 * self.steps
            head += self.steps**2 * d
        return 2 * self.windows * (squares * d**2 + attention + head)
