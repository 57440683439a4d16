// Drives the bones of a mesh that was loaded from the stream's GLB file, and draws contact forces as arrows.
#if UNITY_5_3_OR_NEWER
using System;
using System.Collections.Generic;
using System.Text;
using UnityEngine;

namespace Femsense
{
    public sealed class FemsenseRobot : MonoBehaviour
    {
        public FemsenseStream stream;
        [Tooltip("As in the topics femsense/<robot>/...")] public string robot = "";
        [Tooltip("The node robot_frame of the loaded mesh, or any transform turned by -90 degrees about x")] public Transform robotFrame;
        [Tooltip("Length of an arrow of one newton [m]")] public float metresPerNewton = 0.05f;
        [Tooltip("A pose that is older is stale [s]")] public float staleAfter = 0.4f;
        /// <summary>What the sender says of itself: waiting (for its first pose), live, stale, ended or lost.</summary>
        public Status Status { get; private set; }
        /// <summary>What is said of the newest frame; anything but "ok" is doubtful.</summary>
        public string FrameStatus { get; private set; }
        /// <summary>The newest answer to a drag; more follow while it is "converging".</summary>
        public Reach Reach { get; private set; }
        public bool IsStale { get { return (Status != null && Status.IsOld) || Time.unscaledTime - arrived > staleAfter; } }
        public bool IsDoubtful { get { return !string.IsNullOrEmpty(FrameStatus) && FrameStatus != "ok"; } }
        private readonly List<Transform> bones = new List<Transform>();
        private readonly List<LineRenderer> arrows = new List<LineRenderer>();
        private readonly float[] place = new float[3];
        private readonly float[] turn = new float[4];
        private float arrived = float.NegativeInfinity;

        [Serializable] private class Vector { public float x = 0, y = 0, z = 0; }
        [Serializable] private class Contact { public Vector point_m = null, force_n = null; public float size_n = 0, std_n = float.NaN; }
        [Serializable] private class Forces { public Contact[] contacts = null; }
        [Serializable] private class Bone { public string name = ""; }
        [Serializable] private class Model { public Bone[] bones = null; }

        /// <summary>Ends all motion of the robot, whoever steers it.</summary>
        public void Stop()
        {
            stream.Stop(robot);
        }

        private void Update()
        {
            var model = stream.Take("femsense/" + robot + "/model");
            if (model != null) Find(JsonUtility.FromJson<Model>(Encoding.UTF8.GetString(model)));
            var bytes = stream.Take("femsense/" + robot + "/pose");
            var pose = bytes == null ? null : Pose.Read(bytes);
            if (pose != null) Show(pose);
            var forces = stream.Take("femsense/" + robot + "/force");
            if (forces != null)
            {
                Show(JsonUtility.FromJson<Forces>(Encoding.UTF8.GetString(forces)));
                FrameStatus = Document.Text(forces, "status");
            }
            var status = stream.Take("femsense/" + robot + "/status");
            if (status != null) Status = Status.Read(status) ?? Status;
            var reach = stream.Take("femsense/" + robot + "/reach");
            if (reach != null) Reach = Reach.Read(reach) ?? Reach;
        }

        private void Find(Model model)
        {
            bones.Clear();
            foreach (var bone in model.bones) bones.Add(robotFrame.Find(bone.name));
        }

        private void Show(Pose pose)
        {
            arrived = Time.unscaledTime;
            for (int b = 0; b < Math.Min(bones.Count, pose.Count); b++)
            {
                if (bones[b] == null) continue;
                var v = pose.Bones;
                int i = 7 * b;
                Frame.Place(v[i], v[i + 1], v[i + 2], place);
                Frame.Turn(v[i + 3], v[i + 4], v[i + 5], v[i + 6], turn);
                bones[b].localPosition = new Vector3(place[0], place[1], place[2]);
                bones[b].localRotation = new Quaternion(turn[0], turn[1], turn[2], turn[3]);
            }
        }

        private void Show(Forces forces)
        {
            int count = forces.contacts == null ? 0 : forces.contacts.Length;
            while (arrows.Count < count) arrows.Add(NewArrow());
            for (int i = 0; i < arrows.Count; i++)
            {
                arrows[i].gameObject.SetActive(i < count);
                if (i >= count) continue;
                var tip = Here(forces.contacts[i].point_m);
                arrows[i].SetPosition(0, tip - metresPerNewton * Here(forces.contacts[i].force_n));
                arrows[i].SetPosition(1, tip);
            }
        }

        private Vector3 Here(Vector v)
        {
            Frame.Place(v.x, v.y, v.z, place);
            return new Vector3(place[0], place[1], place[2]);
        }

        private LineRenderer NewArrow()
        {
            var line = new GameObject("force").AddComponent<LineRenderer>();
            line.transform.SetParent(robotFrame, false);
            line.useWorldSpace = false;
            line.positionCount = 2;
            line.startWidth = 0.004f;
            line.endWidth = 0.0f;
            line.startColor = line.endColor = new Color(1.0f, 0.61f, 0.2f);
            line.material = new Material(Shader.Find("Sprites/Default"));
            return line;
        }
    }
}
#endif
