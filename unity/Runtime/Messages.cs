// The bytes of a stream (docs/streaming.md), and the only place where frames of reference are converted. Needs no Unity.
using System;
using System.Collections.Generic;
using System.Text;

namespace Femsense
{
    /// <summary>A payload for a topic.</summary>
    public struct Message
    {
        public string Topic;
        public byte[] Payload;
    }

    /// <summary>Bones of a robot at one time; right-handed robot frame, metres.</summary>
    public sealed class Pose
    {
        public uint Seq;
        public double TimeS;
        /// <summary>x y z qx qy qz qw of each bone.</summary>
        public float[] Bones;

        public int Count { get { return Bones.Length / 7; } }

        /// <summary>Returns the pose in a message, or null where it holds none.</summary>
        public static Pose Read(byte[] payload)
        {
            if (payload.Length < 20 || Encoding.ASCII.GetString(payload, 0, 4) != "FSP1") return null;
            int count = BitConverter.ToUInt16(payload, 16);
            if (payload.Length != 20 + 28 * count) return null;
            var pose = new Pose { Seq = BitConverter.ToUInt32(payload, 4), TimeS = BitConverter.ToDouble(payload, 8), Bones = new float[7 * count] };
            Buffer.BlockCopy(payload, 20, pose.Bones, 0, 28 * count);
            return pose;
        }
    }

    /// <summary>From the right-handed robot frame to Unity's left-handed one, under a transform turned by -90 degrees about x.</summary>
    public static class Frame
    {
        /// <summary>A mirror image at x = 0, as glTF importers make it: apply to places and directions.</summary>
        public static void Place(float x, float y, float z, float[] into)
        {
            into[0] = -x;
            into[1] = y;
            into[2] = z;
        }

        /// <summary>The same for a rotation x y z w.</summary>
        public static void Turn(float x, float y, float z, float w, float[] into)
        {
            into[0] = x;
            into[1] = -y;
            into[2] = -z;
            into[3] = w;
        }
    }

    /// <summary>Frames of the WebSocket: topic length uint16, payload length uint32, topic, payload, again and again.</summary>
    public static class Frames
    {
        public static List<Message> Read(byte[] frame, int length)
        {
            var found = new List<Message>();
            int at = 0;
            while (at + 6 <= length)
            {
                int name = BitConverter.ToUInt16(frame, at);
                long size = BitConverter.ToUInt32(frame, at + 2);
                if (at + 6 + name + size > length) break;
                var payload = new byte[size];
                Buffer.BlockCopy(frame, at + 6 + name, payload, 0, (int)size);
                found.Add(new Message { Topic = Encoding.UTF8.GetString(frame, at + 6, name), Payload = payload });
                at += 6 + name + (int)size;
            }
            return found;
        }
    }
}
