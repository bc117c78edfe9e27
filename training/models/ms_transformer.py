"""MS-T: the multi-scene transformer (Shavit, Ferens and Keller, 2021), with heads shared by all scenes."""

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.store.hints import setting_of
from groundwalk.training.models.efficientnet import REDUCTION_8_CHANNELS, REDUCTION_16_CHANNELS, EfficientNetB0
from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import MSTransformerSettings

WIDTH = 256
HEADS = 8
FEED_FORWARD = 256
HEAD_HIDDEN = 1024
MAX_CELLS = 50  # rows or columns of a feature map that have an embedding


class FeedForward(nn.Sequential):
    def __init__(self, dropout: float) -> None:
        super().__init__(nn.Linear(WIDTH, FEED_FORWARD), nn.GELU(), nn.Dropout(dropout), nn.Linear(FEED_FORWARD, WIDTH))


class Attention(nn.MultiheadAttention):
    """Multi-head attention (B, N, 256), returning the attended values only."""

    def __init__(self, dropout: float) -> None:
        super().__init__(WIDTH, HEADS, dropout=dropout, batch_first=True)

    def attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        return self(query, key, value, need_weights=False)[0]


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward, each behind its norm; positions enter queries and keys in every layer."""

    def __init__(self, dropout: float) -> None:
        super().__init__()
        self.attention = Attention(dropout)
        self.feed_forward = FeedForward(dropout)
        self.norm1, self.norm2 = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.dropout = nn.Dropout(dropout)

    def forward(self, cells: Tensor, place: Tensor) -> Tensor:
        x = self.norm1(cells)
        cells = cells + self.dropout(self.attention.attend(x + place, x + place, x))
        return cells + self.dropout(self.feed_forward(self.norm2(cells)))


class DecoderLayer(nn.Module):
    """Attention among the scene queries, then from them to the encoded cells, then feed-forward."""

    def __init__(self, dropout: float) -> None:
        super().__init__()
        self.self_attention, self.cross_attention = Attention(dropout), Attention(dropout)
        self.feed_forward = FeedForward(dropout)
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(WIDTH) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def forward(self, scenes: Tensor, query: Tensor, cells: Tensor, place: Tensor) -> Tensor:
        x = self.norm1(scenes)
        scenes = scenes + self.dropout(self.self_attention.attend(x + query, x + query, x))
        x = self.norm2(scenes) + query
        scenes = scenes + self.dropout(self.cross_attention.attend(x, cells + place, cells))
        return scenes + self.dropout(self.feed_forward(self.norm3(scenes)))


class Transformer(nn.Module):
    """Pre-norm encoder-decoder: feature map (B, C, H, W) and its places (HW, 256) to one vector (B, S, 256) a
    scene query."""

    def __init__(self, channels: int, scenes: int, layers: int, dropout: float) -> None:
        super().__init__()
        self.project = nn.Conv2d(channels, WIDTH, 1)
        self.queries = nn.Embedding(scenes, WIDTH)
        self.encoder = nn.ModuleList(EncoderLayer(dropout) for _ in range(layers))
        self.encoder_norm = nn.LayerNorm(WIDTH)
        self.decoder = nn.ModuleList(DecoderLayer(dropout) for _ in range(layers))
        self.decoder_norm = nn.LayerNorm(WIDTH)
        for parameter in (*self.encoder.parameters(), *self.decoder.parameters()):
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, feature_map: Tensor, place: Tensor) -> Tensor:
        cells = self.project(feature_map).flatten(2).transpose(1, 2)
        for layer in self.encoder:
            cells = layer(cells, place)
        cells = self.encoder_norm(cells)
        query = self.queries.weight.expand(len(cells), -1, -1)
        scenes = torch.zeros_like(query)
        for layer in self.decoder:
            scenes = layer(scenes, query, cells, place)
        return self.decoder_norm(scenes)


class PoseHead(nn.Sequential):
    def __init__(self, outputs: int) -> None:
        hidden, output = nn.Linear(WIDTH, HEAD_HIDDEN), nn.Linear(HEAD_HIDDEN, outputs)
        super().__init__(hidden, nn.GELU(), output)
        for layer in (hidden, output):
            nn.init.kaiming_normal_(layer.weight)
            nn.init.zeros_(layer.bias)


class MSTransformer(BackboneRegressor):
    """Position from the 1/16 map, rotation from the 1/8 map; a query a scene, and a classifier that picks one.

    The backbone is the whole EfficientNet-B0: its layers after the 1/16 map and its classifier don't run, but a
    weights file holds them, and the 70.9 MiB of the original count them.
    """

    backbone: EfficientNetB0
    recordable = True
    backbone_url = "https://download.pytorch.org/models/efficientnet_b0_rwightman-7f5810bc.pth"

    def __init__(self, settings: MSTransformerSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        layers, dropout = settings.layers, settings.dropout
        self.branch_layers = layers
        # The authors' backbone drops its last block twice as often as their transformers drop features.
        self.backbone = EfficientNetB0(stochastic_depth=min(0.2, 2 * dropout))
        self.position_transformer = Transformer(REDUCTION_16_CHANNELS, scenes, layers, dropout)
        self.rotation_transformer = Transformer(REDUCTION_8_CHANNELS, scenes, layers, dropout)
        self.row_embedding = nn.Embedding(MAX_CELLS, WIDTH // 2)
        self.column_embedding = nn.Embedding(MAX_CELLS, WIDTH // 2)
        nn.init.uniform_(self.row_embedding.weight)
        nn.init.uniform_(self.column_embedding.weight)
        self.scene_logit = nn.Linear(2 * WIDTH, 1)
        self.position_head, self.rotation_head = PoseHead(3), PoseHead(4)

    def layers(self) -> str:
        return f"{self.branch_layers} encoder and {self.branch_layers} decoder layers a branch"

    def _place(self, feature_map: Tensor) -> Tensor:
        """What the transformer adds to a map's cells (HW, 256): column embedding, then row embedding."""
        height, width = feature_map.shape[-2:]
        if max(height, width) > MAX_CELLS:
            raise UserError(
                "MS-T has no places for images this large",
                expected=f"{8 * MAX_CELLS} px a side at most, an eighth of which is {MAX_CELLS} cells",
                found=f"a map of {width} x {height} cells",
                do=f"set a smaller {setting_of('train', 'crop')}",
            )
        columns = self.column_embedding.weight[:width].expand(height, width, -1)
        rows = self.row_embedding.weight[:height, None].expand(height, width, -1)
        return torch.cat([columns, rows], dim=-1).flatten(0, 1)

    def _maps(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """The backbone's maps. On a CPU bfloat16 speeds products up and slows depthwise convolutions down."""
        if image_B3HW.device.type != "cpu":
            return self.backbone.maps(image_B3HW)
        with torch.autocast("cpu", enabled=False):
            return self.backbone.maps(image_B3HW)

    def _decode(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The two branches' vectors (B, S, 256) and the scene logits (B, S)."""
        map_8, map_16 = self._maps(image_B3HW)
        position_BSC = self.position_transformer(map_16, self._place(map_16))
        rotation_BSC = self.rotation_transformer(map_8, self._place(map_8))
        with torch.autocast(image_B3HW.device.type, enabled=False):
            position_BSC, rotation_BSC = position_BSC.float(), rotation_BSC.float()
            logits_BS = self.scene_logit(torch.cat([position_BSC, rotation_BSC], dim=-1)).squeeze(-1)
        return position_BSC, rotation_BSC, logits_BS

    def _regress(self, position_BSC: Tensor, rotation_BSC: Tensor, scene_B: Tensor) -> tuple[Tensor, Tensor]:
        """Position (B, 3) and unit quaternion (B, 4) from the vectors of one scene a sample, all in one batch."""
        index = scene_B[:, None, None].expand(-1, 1, WIDTH)
        with torch.autocast(position_BSC.device.type, enabled=False):
            position = self.position_head(position_BSC.gather(1, index).squeeze(1))
            quaternion = self.rotation_head(rotation_BSC.gather(1, index).squeeze(1))
        return position, nn.functional.normalize(quaternion, dim=-1)

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        position_BSC, rotation_BSC, logits_BS = self._decode(image_B3HW)
        scene = logits_BS.argmax(dim=1)
        return self.frames.to_map(*self._regress(position_BSC, rotation_BSC, scene), scene)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """L2 of position and of unit quaternion, plus the scene's negative log-likelihood.

        q and -q are the same rotation, so the nearer of the two counts.
        """
        position_BSC, rotation_BSC, logits_BS = self._decode(image_B3HW)
        position, quaternion = self._regress(position_BSC, rotation_BSC, poses.scene_B)
        true_position, true_quaternion = self.frames.from_map(poses)
        position_loss = torch.linalg.vector_norm(position - true_position, dim=-1).mean()
        rotation_loss = torch.minimum(
            torch.linalg.vector_norm(quaternion - true_quaternion, dim=-1),
            torch.linalg.vector_norm(quaternion + true_quaternion, dim=-1),
        ).mean()
        scene_loss = nn.functional.cross_entropy(logits_BS, poses.scene_B)
        return self.loss_weights(position_loss, rotation_loss) + scene_loss
