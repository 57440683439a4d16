// Puts a stream into the scene, and shows what a robot says of itself while it plays.
using UnityEditor;
using UnityEngine;

namespace Femsense
{
    public static class FemsenseMenu
    {
        [MenuItem("GameObject/femsense/Stream", false, 10)]
        private static void AddStream()
        {
            var made = new GameObject("femsense", typeof(FemsenseStream), typeof(FemsenseScene));
            Undo.RegisterCreatedObjectUndo(made, "Add femsense stream");
            Selection.activeGameObject = made;
        }
    }

    [CustomEditor(typeof(FemsenseRobot))]
    public sealed class FemsenseRobotEditor : Editor
    {
        public override void OnInspectorGUI()
        {
            DrawDefaultInspector();
            var robot = (FemsenseRobot)target;
            if (!Application.isPlaying) return;
            EditorGUILayout.LabelField("Status", robot.Status == null ? "nothing yet" : robot.Status.State + " " + robot.Status.Detail);
            EditorGUILayout.LabelField("Frame", robot.FrameStatus ?? "");
            if (GUILayout.Button("Stop all motion")) robot.Stop();
        }

        public override bool RequiresConstantRepaint()
        {
            return Application.isPlaying;
        }
    }
}
