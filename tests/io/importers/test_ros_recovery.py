"""Both ways of reading one bag give the same messages."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rosbags")
from ros_writers import BagWriter, write_camera

from femsense.core.errors import InputError
from femsense.io.importers.ros.bag import open_bag
from femsense.io.importers.ros.recovery import RecoveredReader


@pytest.mark.parametrize("kind", ["1", "mcap"])
def test_a_whole_bag_read_without_its_index(kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("take.bag" if kind == "1" else "take")
    with BagWriter(path, kind) as bag:
        write_camera(bag, 20)
    file = path if kind == "1" else path / "take.mcap"
    recovered = RecoveredReader(file)
    with open_bag(file) as whole:
        topics = {t.name: (t.type, t.count) for t in whole.topics}
        assert {c.topic: (c.msgtype, c.msgcount) for c in recovered.connections} == topics
        mine = sorted((at, c.topic, raw) for c, at, raw in recovered.messages(recovered.connections))
        theirs = sorted((round(1e9 * m.record), m.topic, m.raw) for m in whole.messages(list(topics)))
        assert [(t, r) for _, t, r in mine] == [(t, r) for _, t, r in theirs]
        image = next(raw for _, topic, raw in mine if topic == "/camera/color/image_raw")
        assert recovered.deserialize(image, "sensor_msgs/msg/Image").encoding == "rgb8"


def test_nothing_whole_is_an_error(tmp_path: Path) -> None:
    for name, data in (("a.bag", b"#ROSBAG V2.0\n" + bytes(100)), ("a.mcap", b"\x89MCAP0\r\n" + bytes(100))):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match="without a whole message"):
            RecoveredReader(tmp_path / name)


def test_a_chunk_that_was_cut_off_gives_its_whole_messages(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take.bag", "1", chunk=1 << 24) as bag:
        write_camera(bag, 20)
    data = (tmp_path / "take.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: len(data) // 2])
    whole, cut = RecoveredReader(tmp_path / "take.bag"), RecoveredReader(tmp_path / "cut.bag")
    assert 0.4 * whole.count < cut.count < 0.6 * whole.count
    for mine, theirs in zip(cut.messages(cut.connections), whole.messages(whole.connections)):
        assert (mine[0].topic, mine[1], mine[2]) == (theirs[0].topic, theirs[1], theirs[2])


@pytest.mark.parametrize("compression", ["NONE", "ZSTD", "LZ4"])
def test_a_chunk_of_mcap_that_was_cut_off(compression: str, tmp_path: Path) -> None:
    """Compressed ones too give what comes before the break: as blocks of the compression allow."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 20)
    kinds, channels = {}, {}
    with (tmp_path / "take/take.mcap").open("rb") as source, (tmp_path / "one.mcap").open("wb") as sink:
        writer = Writer(sink, compression=CompressionType[compression], chunk_size=1 << 24)
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                assert schema is not None
                kinds[channel.topic] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", kinds[channel.topic])
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    data = (tmp_path / "one.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
    whole, cut = RecoveredReader(tmp_path / "one.mcap"), RecoveredReader(tmp_path / "cut.mcap")
    assert 0.2 * whole.count < cut.count < whole.count
    for mine, theirs in zip(cut.messages(cut.connections), whole.messages(whole.connections)):
        assert (mine[0].topic, mine[1], mine[2]) == (theirs[0].topic, theirs[1], theirs[2])


def test_a_folder_whose_metadata_is_broken(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "take", "mcap") as bag:
        write_camera(bag, 2)
    (tmp_path / "take/metadata.yaml").write_text("rosbag2_bagfile_information: [1,")
    with pytest.warns(UserWarning, match="metadata.yaml is broken"), open_bag(tmp_path / "take") as read:
        assert any(topic.count == 2 for topic in read.topics)
