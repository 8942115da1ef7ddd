"""Checkpoints of small models that find words, with random weights: Grounding DINO and SAM 3."""

import torch

WORDS = ("red", "blue", "cup", "book", "table", "sphere", "##s", "two", "five", "one")
"""All words that the small models read."""
SIDE = 56
"""Side in pixels of the input of the small SAM 3."""


def write_words(folder):
    """Write the vocabulary of a BERT, with the numbers that Grounding DINO expects of the marks between phrases."""
    words = [f"[unused{number}]" for number in range(1100)]
    words[0], words[100:104] = "[PAD]", ["[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    words[1012], words[1029] = ".", "?"
    words[1040 : 1040 + len(WORDS)] = WORDS
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.txt").write_text("\n".join(words) + "\n")


def write_small_detector(folder):
    """Write a checkpoint of a small Grounding DINO to a folder."""
    import transformers

    torch.manual_seed(0)
    backbone = transformers.SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4, out_indices=[2, 3, 4]
    )
    text = transformers.BertConfig(
        vocab_size=1100, hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16
    )
    config = transformers.GroundingDinoConfig(
        backbone_config=backbone, text_config=text, num_queries=12, d_model=32, encoder_layers=1, decoder_layers=2,
        encoder_ffn_dim=32, decoder_ffn_dim=32, encoder_attention_heads=2, decoder_attention_heads=2,
        encoder_n_points=2, decoder_n_points=2, max_text_len=32,
    )  # fmt: skip
    _randomize(transformers.GroundingDinoForObjectDetection(config)).save_pretrained(folder)
    write_words(folder)


def write_small_sam3(folder, video=False):
    """Write a checkpoint of a small SAM 3 to a folder, or of one for videos, which contains that for photos."""
    import transformers

    torch.manual_seed(0)
    backbone = {
        "model_type": "sam3_vit_model", "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": SIDE, "patch_size": 14, "window_size": 2, "global_attn_indexes": [1],
        "pretrain_image_size": 28,
    }  # fmt: skip
    small = {"hidden_size": 32, "num_attention_heads": 2, "intermediate_size": 32}
    config = transformers.Sam3Config(
        vision_config={
            "backbone_config": backbone, "fpn_hidden_size": 32, "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        },
        text_config={
            "vocab_size": 50, "hidden_size": 16, "intermediate_size": 16, "projection_dim": 16, "num_hidden_layers": 1,
            "num_attention_heads": 2, "max_position_embeddings": 8, "eos_token_id": 1, "bos_token_id": 0,
        },
        geometry_encoder_config={**small, "num_layers": 1}, detr_encoder_config={**small, "num_layers": 1},
        detr_decoder_config={**small, "num_layers": 1, "num_queries": 6},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
    )  # fmt: skip
    model = transformers.Sam3Model(config)
    if video:
        model = transformers.Sam3VideoModel(transformers.Sam3VideoConfig(detector_config=config.to_dict()))
    _randomize(model).save_pretrained(folder)
    write_sam3_words(folder)


def write_sam3_words(folder):
    """Write a tokenizer for SAM 3 that knows whole words."""
    import transformers
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    words = {word: number for number, word in enumerate(("<|startoftext|>", "<|endoftext|>", "<unk>", *WORDS))}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    ends = [(word, words[word]) for word in ("<|startoftext|>", "<|endoftext|>")]
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{ends[0][0]} $A {ends[1][0]}", special_tokens=ends
    )
    transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token=ends[1][0]).save_pretrained(folder)


def _randomize(model):
    """Give a model weights that make its answers depend on all of its input."""
    with torch.no_grad():
        for values in model.parameters():
            values.normal_(0, 0.2) if values.ndim > 1 else values.add_(0.01)
    return model
