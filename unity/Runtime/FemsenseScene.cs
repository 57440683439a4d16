// Shows every robot that a stream announces: loads its mesh with glTFast and drives its bones.
#if UNITY_5_3_OR_NEWER
using System;
using System.Collections.Generic;
using System.Text;
using System.Threading.Tasks;
using GLTFast;
using UnityEngine;
using UnityEngine.Networking;

namespace Femsense
{
    [RequireComponent(typeof(FemsenseStream))]
    public sealed class FemsenseScene : MonoBehaviour
    {
        [Tooltip("Between robots, as they come [m]")] public float distance = 0.4f;
        private readonly Dictionary<string, FemsenseRobot> robots = new Dictionary<string, FemsenseRobot>();
        private FemsenseStream stream;

        private void Awake()
        {
            stream = GetComponent<FemsenseStream>();
        }

        private void Update()
        {
            foreach (var name in stream.Robots)
            {
                if (robots.ContainsKey(name)) continue;
                robots[name] = null; // it is on its way
                Load(name);
            }
        }

        private async void Load(string name)
        {
            try
            {
                var place = new GameObject(name).transform;
                place.SetParent(transform, false);
                place.localPosition = new Vector3(distance * (robots.Count - 1), 0.0f, 0.0f);
                var import = new GltfImport();
                var still = new ImportSettings { AnimationMethod = AnimationMethod.None };
                if (!await import.LoadGltfBinary(await Download(name), null, still)) throw new InvalidOperationException("no glTF");
                if (!await import.InstantiateMainSceneAsync(place)) throw new InvalidOperationException("no scene in it");
                var robot = place.gameObject.AddComponent<FemsenseRobot>();
                robot.stream = stream;
                robot.robot = name;
                robot.robotFrame = Find(place, "robot_frame");
                robots[name] = robot;
            }
            catch (Exception error)
            {
                Debug.LogError("femsense: the mesh of " + name + ": " + error.Message);
            }
        }

        private async Task<byte[]> Download(string name)
        {
            var page = new Uri(stream.url);
            var url = (page.Scheme == "wss" ? "https://" : "http://") + page.Authority + "/robots/" + name + ".glb";
            using (var request = UnityWebRequest.Get(url))
            {
                if (stream.password.Length > 0) request.SetRequestHeader("Authorization", stream.Authorization);
                var going = request.SendWebRequest();
                while (!going.isDone) await Task.Yield();
                if (request.responseCode != 200) throw new InvalidOperationException(url + ": " + request.responseCode + " " + request.error);
                return request.downloadHandler.data;
            }
        }

        private static Transform Find(Transform from, string name)
        {
            if (from.name == name) return from;
            for (int i = 0; i < from.childCount; i++)
            {
                var found = Find(from.GetChild(i), name);
                if (found != null) return found;
            }
            return null;
        }
    }
}
#endif
