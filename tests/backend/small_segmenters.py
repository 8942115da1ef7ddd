"""Checkpoints of small segmentation models with random weights, made with transformers."""

from types import SimpleNamespace

import torch

SIDE = 64
"""Side in pixels of the inputs of the small models."""
KINDS = ("sam", "sam2", "sam2_video", "edgetam")


def _small_backbone(transformers):
    """Register a backbone for EdgeTAM, in place of that of the package timm."""

    class Config(transformers.PreTrainedConfig):
        model_type = "small_backbone"

    class Backbone(transformers.PreTrainedModel):
        config_class = Config
        main_input_name = "pixel_values"

        def __init__(self, config):
            super().__init__(config)
            sizes = (3, 8, 8, 8, 8)
            steps = (4, 2, 2, 2)
            self.layers = torch.nn.ModuleList(
                torch.nn.Conv2d(before, after, step, step) for before, after, step in zip(sizes, sizes[1:], steps)
            )
            self.post_init()

        def forward(self, pixel_values, **_):
            found = []
            for layer in self.layers:
                pixel_values = layer(pixel_values)
                found.append(pixel_values)
            return SimpleNamespace(last_hidden_state=found, hidden_states=None)

    transformers.AutoConfig.register("small_backbone", Config, exist_ok=True)
    transformers.AutoModel.register(Config, Backbone, exist_ok=True)
    return Config()


def _small_model(transformers, kind):
    """Return a small model with random weights."""
    torch.manual_seed(0)
    prompts = {"hidden_size": 32, "image_size": SIDE, "patch_size": 16, "mask_input_channels": 8}
    decoder = {
        "hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "num_hidden_layers": 1, "iou_head_hidden_dim": 16,
    }  # fmt: skip
    if kind == "sam":
        vision = {
            "hidden_size": 16, "output_channels": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": SIDE, "window_size": 2, "global_attn_indexes": [1], "num_pos_feats": 16,
        }  # fmt: skip
        config = transformers.SamConfig(
            vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config={**decoder, "num_hidden_layers": 2}
        )
        return transformers.SamModel(config)
    sizes = [[SIDE // step] * 2 for step in (4, 8, 16)]
    neck = {"backbone_feature_sizes": sizes, "fpn_hidden_size": 32}
    parts = {"prompt_encoder_config": prompts, "mask_decoder_config": decoder}
    if kind == "edgetam":
        vision = transformers.EdgeTamVisionConfig(
            backbone_config=_small_backbone(transformers), backbone_channel_list=[8, 8, 8, 8], **neck
        )
        return transformers.EdgeTamModel(transformers.EdgeTamConfig(vision_config=vision, **parts))
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 1, 1], "window_size_per_stage": [8, 4, 4, 2],
        "global_attention_blocks": [3],
    }  # fmt: skip
    vision = transformers.Sam2VisionConfig(backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], **neck)
    if kind == "sam2":
        return transformers.Sam2Model(transformers.Sam2Config(vision_config=vision, **parts))
    memory = {
        "image_size": SIDE, "memory_attention_hidden_size": 32, "memory_attention_feed_forward_hidden_size": 32,
        "memory_attention_num_layers": 1, "memory_attention_rope_feat_sizes": [4, 4], "memory_encoder_hidden_size": 32,
        "memory_encoder_output_channels": 16, "mask_downsampler_embed_dim": 32, "memory_fuser_embed_dim": 32,
        "memory_fuser_intermediate_dim": 32, "memory_fuser_num_layers": 1,
    }  # fmt: skip
    return transformers.Sam2VideoModel(transformers.Sam2VideoConfig(vision_config=vision, **parts, **memory))


def write_small_model(folder, kind):
    """Write a checkpoint of a small model of a kind to a folder."""
    import transformers

    model = _small_model(transformers, kind)
    with torch.no_grad():
        for values in model.parameters():
            values.normal_(0, 0.1) if values.ndim > 1 else values.add_(0.01)
    model.save_pretrained(folder)
