// Moves the camera with the head, by whatever XR plug-in runs: OpenXR on HoloLens 2 and on Quest.
using UnityEngine;
using UnityEngine.XR;

namespace Femsense.Samples
{
    public sealed class HeadPose : MonoBehaviour
    {
        private void LateUpdate()
        {
            var head = InputDevices.GetDeviceAtXRNode(XRNode.CenterEye);
            Vector3 place;
            Quaternion turn;
            if (head.TryGetFeatureValue(CommonUsages.centerEyePosition, out place)) transform.localPosition = place;
            if (head.TryGetFeatureValue(CommonUsages.centerEyeRotation, out turn)) transform.localRotation = turn;
        }
    }
}
