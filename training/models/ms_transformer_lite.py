"""MST-Lite: MS-T's transformers on maps of a frozen EfficientNet-Lite0, with a mixture of poses for each scene."""

import torch
from torch import Tensor, nn

from groundwalk.training.models.efficientnet_lite import MAP_CHANNELS
from groundwalk.training.models.ms_transformer import MAX_CELLS, WIDTH, DecoderLayer
from groundwalk.training.models.posenet_lite import COMPONENTS, LiteRegressor, last_layers
from groundwalk.training.models.posenet_lite import WIDTH as SUMMARY
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import MSTransformerLiteSettings

# So many cells of a map, in a square, become one cell of its transformer.
PATCH_8, PATCH_16 = 3, 2
_DECODER_DROPOUT = 0.1
_ATTENTION_DROPOUT = 0.5  # share of a training step's images that are answered without attention to maps


class LiteTransformer(nn.Module):
    """A map (B, C, H, W) and the whitened summary (B, F) of an image to one vector (B, S, 256) a scene query.

    The queries start at the summary, and attend to the map's cells as they are: an encoder of these took most of the
    training time, in which more epochs gain more.
    """

    def __init__(self, channels: int, patch: int, scenes: int, summary: int) -> None:
        super().__init__()
        self.patch = patch
        # `project` has weights of its own for each channel; without them no gradient goes through the map.
        self.norm = nn.BatchNorm2d(channels, affine=False)
        self.project = nn.Conv2d(channels, WIDTH, patch, patch)
        self.cells_norm = nn.LayerNorm(WIDTH)
        self.start = nn.Linear(summary, WIDTH)
        self.queries = nn.Embedding(scenes, WIDTH)
        self.row_embedding = nn.Embedding(MAX_CELLS, WIDTH)
        self.column_embedding = nn.Embedding(MAX_CELLS, WIDTH)
        for embedding in (self.row_embedding, self.column_embedding):
            nn.init.normal_(embedding.weight, std=0.02)
        self.decoder = DecoderLayer(_DECODER_DROPOUT)
        self.decoder_norm = nn.LayerNorm(WIDTH)

    def forward(self, feature_map: Tensor, summary: Tensor) -> Tensor:
        height, width = feature_map.shape[-2:]
        # A map that its patches don't fill is continued, so that no cell is left out.
        whole = nn.functional.pad(
            self.norm(feature_map), (0, -width % self.patch, 0, -height % self.patch), mode="replicate"
        )
        patches = self.project(whole)
        rows = self.row_embedding.weight[: patches.shape[-2], None]
        place = (rows + self.column_embedding.weight[: patches.shape[-1]]).flatten(0, 1)
        cells = self.cells_norm(patches.flatten(2).transpose(1, 2))
        query = self.queries.weight.expand(len(cells), -1, -1)
        scenes = self.start(summary)[:, None] + query
        return self.decoder_norm(self.decoder(scenes, query, cells, place))


class AttentionHead(nn.Module):
    """A mixture's outputs from the summary and from what the queries found."""

    def __init__(self, dropout: float, width: int, components: int) -> None:
        super().__init__()
        self.from_summary = nn.Linear(width, width)
        self.from_attention = nn.Linear(2 * WIDTH, width)
        # Attention only adds to what the summary tells, from nothing on.
        nn.init.zeros_(self.from_attention.weight)
        nn.init.zeros_(self.from_attention.bias)
        self.layers = nn.Sequential(*last_layers(dropout, width, components))

    def forward(self, summary: Tensor, attended: Tensor) -> Tensor:
        outputs: Tensor = self.layers(self.from_summary(summary) + self.from_attention(attended))
        return outputs


class MSTransformerLite(LiteRegressor):
    """A mixture of poses from the summary, as PN-Lite's, and from what a query a scene finds in the 1/16 and in the 1/8
    map; a classifier picks the scene."""

    def __init__(self, scenes: int, dropout: float = 0.3, width: int = SUMMARY, components: int = COMPONENTS) -> None:
        super().__init__(scenes, width, components)
        self.summary_dropout = nn.Dropout(dropout / 2)
        self.transformers = nn.ModuleList(
            LiteTransformer(channels, patch, scenes, width)
            for channels, patch in ((MAP_CHANNELS[1], PATCH_16), (MAP_CHANNELS[0], PATCH_8))
        )
        self.scene_logit = nn.Linear(2 * WIDTH, 1)
        self.summary_logits = nn.Linear(width, scenes)
        self.attention_dropout = nn.Dropout(_ATTENTION_DROPOUT)
        self.head = AttentionHead(dropout, width, components)

    def layers(self) -> str:
        return "1 decoder layer a map"

    def features(self, image_B3HW: Tensor) -> tuple[Tensor, ...]:
        map_8, map_16, map_32 = self.maps(image_B3HW)
        return self.pooled(map_16, map_32), map_8, map_16

    def _decode(self, features: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """The summary (B, F), both maps' vectors (B, S, 512) and the scene logits (B, S)."""
        whitened, map_8, map_16 = (part.float() for part in features)
        summary = self.summary_dropout(whitened)
        maps = zip(self.transformers, (map_16, map_8), strict=True)
        vectors = torch.cat([transformer(feature_map, summary) for transformer, feature_map in maps], dim=-1)
        return summary, vectors, self.scene_logit(vectors).squeeze(-1) + self.summary_logits(summary)

    def _outputs(self, summary: Tensor, vectors_BSC: Tensor, scene_B: Tensor) -> Tensor:
        """The head's outputs (B, components * OUTPUTS) from the summary and from the vectors of one scene a sample."""
        vector = vectors_BSC.gather(1, scene_B[:, None, None].expand(-1, 1, 2 * WIDTH)).squeeze(1)
        # Of an image all attention is left out or none.
        attended = vector * self.attention_dropout(vector.new_ones(len(vector), 1))
        outputs: Tensor = self.head(summary, attended)
        return outputs

    def answer(self, features: tuple[Tensor, ...]) -> PoseBatch:
        summary, vectors, logits = self._decode(features)
        scene = logits.argmax(dim=1)
        return self.mixed(self._outputs(summary, vectors, scene), scene)

    def feature_loss(self, features: tuple[Tensor, ...], poses: PoseBatch) -> Tensor:
        """The mixture's negative log-likelihood, plus the scene's."""
        summary, vectors, logits = self._decode(features)
        scene_loss = nn.functional.cross_entropy(logits.float(), poses.scene_B)
        return self.mixture_loss(self._outputs(summary, vectors, poses.scene_B), poses) + scene_loss


def make_ms_transformer_lite(settings: MSTransformerLiteSettings, scenes: int, outdoor: bool) -> MSTransformerLite:
    """MST-Lite with random weights."""
    return MSTransformerLite(scenes, settings.dropout)
