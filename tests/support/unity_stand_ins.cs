// Stand-ins for what the package uses of Unity, glTFast and NUnit: enough for a compiler to check names and types, nothing runs.
using System;
using System.Threading;
using System.Threading.Tasks;

namespace UnityEngine
{
    public class Object { public string name; public static implicit operator bool(Object o) { return o != null; } }
    public class Component : Object { public GameObject gameObject; public Transform transform; public T GetComponent<T>() { return default(T); } }
    public class Behaviour : Component { public bool enabled; }
    public class MonoBehaviour : Behaviour { }
    public class GameObject : Object
    {
        public GameObject(string name, params Type[] kinds) { }
        public Transform transform;
        public T AddComponent<T>() where T : Component { return default(T); }
        public void SetActive(bool on) { }
    }
    public class Transform : Component
    {
        public Vector3 localPosition; public Quaternion localRotation; public int childCount;
        public Transform Find(string name) { return null; }
        public Transform GetChild(int i) { return null; }
        public void SetParent(Transform parent, bool stays) { }
    }
    public struct Vector3
    {
        public Vector3(float x, float y, float z) { }
        public static Vector3 operator -(Vector3 a, Vector3 b) { return a; }
        public static Vector3 operator *(float s, Vector3 a) { return a; }
    }
    public struct Quaternion { public Quaternion(float x, float y, float z, float w) { } }
    public struct Color { public Color(float r, float g, float b) { } }
    public class Shader : Object { public static Shader Find(string name) { return null; } }
    public class Material : Object { public Material(Shader shader) { } }
    public class LineRenderer : Component
    {
        public bool useWorldSpace; public int positionCount; public float startWidth, endWidth; public Color startColor, endColor; public Material material;
        public void SetPosition(int i, Vector3 place) { }
    }
    public static class JsonUtility { public static T FromJson<T>(string json) { return default(T); } }
    public static class Time { public static float unscaledTime; }
    public static class Debug { public static void Log(object o) { } public static void LogError(object o) { } }
    public static class Application { public static bool isPlaying; }
    public static class GUILayout { public static bool Button(string text) { return false; } }
    public sealed class TooltipAttribute : Attribute { public TooltipAttribute(string text) { } }
    public sealed class RequireComponent : Attribute { public RequireComponent(Type kind) { } }
    public class AsyncOperation { public bool isDone; }
}
namespace UnityEngine.Networking
{
    public class DownloadHandler { public byte[] data; }
    public class UnityWebRequest : IDisposable
    {
        public static UnityWebRequest Get(string url) { return null; }
        public long responseCode; public string error; public DownloadHandler downloadHandler;
        public void SetRequestHeader(string name, string value) { }
        public AsyncOperation SendWebRequest() { return null; }
        public void Dispose() { }
    }
}
namespace UnityEngine.XR
{
    public enum XRNode { CenterEye }
    public struct InputFeatureUsage<T> { }
    public static class CommonUsages { public static InputFeatureUsage<Vector3> centerEyePosition; public static InputFeatureUsage<Quaternion> centerEyeRotation; }
    public struct InputDevice
    {
        public bool TryGetFeatureValue(InputFeatureUsage<Vector3> usage, out Vector3 value) { value = default(Vector3); return false; }
        public bool TryGetFeatureValue(InputFeatureUsage<Quaternion> usage, out Quaternion value) { value = default(Quaternion); return false; }
    }
    public static class InputDevices { public static InputDevice GetDeviceAtXRNode(XRNode node) { return default(InputDevice); } }
}
namespace UnityEditor
{
    using UnityEngine;
    public class Editor : UnityEngine.Object
    {
        public UnityEngine.Object target;
        public virtual void OnInspectorGUI() { }
        public virtual bool RequiresConstantRepaint() { return false; }
        public bool DrawDefaultInspector() { return false; }
    }
    public sealed class CustomEditor : Attribute { public CustomEditor(Type kind) { } }
    public sealed class MenuItem : Attribute { public MenuItem(string name, bool checks, int priority) { } }
    public static class Undo { public static void RegisterCreatedObjectUndo(UnityEngine.Object o, string name) { } }
    public static class Selection { public static GameObject activeGameObject; }
    public static class EditorGUILayout { public static void LabelField(string name, string value) { } }
}
namespace GLTFast
{
    using UnityEngine;
    public enum AnimationMethod { None, Legacy, Mecanim }
    public class ImportSettings { public AnimationMethod AnimationMethod { get; set; } }
    public class GltfImport
    {
        public Task<bool> LoadGltfBinary(byte[] bytes, Uri uri = null, ImportSettings importSettings = null, CancellationToken token = default(CancellationToken)) { return null; }
        public Task<bool> InstantiateMainSceneAsync(Transform parent, CancellationToken token = default(CancellationToken)) { return null; }
    }
}
namespace NUnit.Framework
{
    public sealed class TestAttribute : Attribute { }
    public static class Assert { public static void AreEqual(object wanted, object found) { } }
}
