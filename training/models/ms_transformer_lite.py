"""MST-Lite: MS-T's transformers on maps of a frozen EfficientNet-Lite0, with a mixture of poses for each scene."""

import torch
from torch import Tensor, nn

from groundwalk.training.models.anchored_mixture import OUTPUTS
from groundwalk.training.models.efficientnet_lite import MAP_CHANNELS
from groundwalk.training.models.ms_transformer import MAX_CELLS, WIDTH, DecoderLayer, EncoderLayer
from groundwalk.training.models.posenet_lite import LiteRegressor
from groundwalk.training.models.regressor import PoseBatch
from groundwalk.training.regressor_settings import MSTransformerLiteSettings

# So many cells of a map, in a square, become one cell of its transformer.
PATCH_8, PATCH_16 = 3, 2
_POSITION = (1, 3, 1)  # outputs a component from the position branch: logit, position, its scale
_ROTATION = (3, 1)


class LiteTransformer(nn.Module):
    """A map (B, C, H, W) and the whitened summary (B, F) of an image to one vector (B, S, 256) a scene query.

    The queries start at the summary, so that attention only adds what it lacks.
    """

    def __init__(self, channels: int, patch: int, scenes: int, settings: MSTransformerLiteSettings) -> None:
        super().__init__()
        self.patch = patch
        self.norm = nn.BatchNorm2d(channels)
        self.project = nn.Conv2d(channels, WIDTH, patch, patch)
        self.start = nn.Linear(settings.width, WIDTH)
        self.queries = nn.Embedding(scenes, WIDTH)
        self.row_embedding = nn.Embedding(MAX_CELLS, WIDTH)
        self.column_embedding = nn.Embedding(MAX_CELLS, WIDTH)
        for embedding in (self.row_embedding, self.column_embedding):
            nn.init.normal_(embedding.weight, std=0.02)
        self.encoder = nn.ModuleList(EncoderLayer(settings.dropout) for _ in range(settings.encoder_layers))
        self.encoder_norm = nn.LayerNorm(WIDTH)
        self.decoder = nn.ModuleList(DecoderLayer(settings.dropout) for _ in range(settings.decoder_layers))
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
        cells = patches.flatten(2).transpose(1, 2)
        for layer in self.encoder:
            cells = layer(cells, place)
        cells = self.encoder_norm(cells)
        query = self.queries.weight.expand(len(cells), -1, -1)
        scenes = self.start(summary)[:, None] + query
        for layer in self.decoder:
            scenes = layer(scenes, query, cells, place)
        return self.decoder_norm(scenes)


class MSTransformerLite(LiteRegressor):
    """Position from the 1/16 map, rotation from the 1/8 map; a query a scene, and a classifier that picks one."""

    def __init__(self, scenes: int, settings: MSTransformerLiteSettings) -> None:
        super().__init__(scenes, settings)
        self.components = settings.components
        self.sizes = settings.encoder_layers, settings.decoder_layers
        self.summary_dropout = nn.Dropout(settings.dropout / 2)
        self.position_transformer = LiteTransformer(MAP_CHANNELS[1], PATCH_16, scenes, settings)
        self.rotation_transformer = LiteTransformer(MAP_CHANNELS[0], PATCH_8, scenes, settings)
        self.scene_logit = nn.Linear(2 * WIDTH, 1)
        self.summary_logits = nn.Linear(settings.width, scenes)
        self.heads = nn.ModuleList()
        for outputs in (sum(_POSITION), sum(_ROTATION)):
            last = nn.Linear(WIDTH, settings.components * outputs)
            with torch.no_grad():
                last.weight *= 0.3  # the anchors themselves are a good first answer
            hidden = nn.Linear(2 * WIDTH, WIDTH)
            self.heads.append(nn.Sequential(hidden, nn.GELU(), nn.Dropout(settings.dropout), last))

    def layers(self) -> str:
        return "{} encoder and {} decoder layers a branch".format(*self.sizes)

    def features(self, image_B3HW: Tensor) -> tuple[Tensor, ...]:
        map_8, map_16, map_32 = self.maps(image_B3HW)
        return self.pooled(map_16, map_32), map_8, map_16

    def _decode(self, features: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Both branches' vectors (B, S, 512) and the scene logits (B, S)."""
        whitened, map_8, map_16 = (part.float() for part in features)
        summary = self.summary_dropout(whitened)
        branches = self.position_transformer(map_16, summary), self.rotation_transformer(map_8, summary)
        vectors = torch.cat(branches, dim=-1)
        return vectors, self.scene_logit(vectors).squeeze(-1) + self.summary_logits(summary)

    def _outputs(self, vectors_BSC: Tensor, scene_B: Tensor) -> Tensor:
        """The mixture's outputs (B, K * OUTPUTS) from the vectors of one scene a sample."""
        vector = vectors_BSC.gather(1, scene_B[:, None, None].expand(-1, 1, 2 * WIDTH)).squeeze(1)
        position, rotation = (head(vector).unflatten(-1, (self.components, -1)) for head in self.heads)
        logit, place, place_scale = position.split(_POSITION, dim=-1)
        turn, turn_scale = rotation.split(_ROTATION, dim=-1)
        outputs = torch.cat([logit, place, turn, place_scale, turn_scale], dim=-1)
        assert outputs.shape[-1] == OUTPUTS
        return outputs.flatten(1)

    def answer(self, features: tuple[Tensor, ...]) -> PoseBatch:
        vectors, logits = self._decode(features)
        scene = logits.argmax(dim=1)
        return self.mixed(self._outputs(vectors, scene), features[0], scene)

    def feature_loss(self, features: tuple[Tensor, ...], poses: PoseBatch) -> Tensor:
        """The mixture's negative log-likelihood, plus the scene's."""
        vectors, logits = self._decode(features)
        scene_loss = nn.functional.cross_entropy(logits.float(), poses.scene_B)
        return self.mixture_loss(self._outputs(vectors, poses.scene_B), poses) + scene_loss


def make_ms_transformer_lite(settings: MSTransformerLiteSettings, scenes: int, outdoor: bool) -> MSTransformerLite:
    """MST-Lite with random weights."""
    return MSTransformerLite(scenes, settings)
