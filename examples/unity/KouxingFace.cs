// Unity 2021 or newer: add this component to an avatar. It moves every SkinnedMeshRenderer below the
// avatar that has blendshapes of ARKit, Oculus or VRM, also under the names of other programs.

using System.Linq;
using UnityEngine;

public sealed class KouxingFace : MonoBehaviour
{
    [SerializeField] string gateway = "ws://127.0.0.1:8080";
    [SerializeField, Tooltip("Session to follow; if empty, the newest")] string session = "";
    [SerializeField, Tooltip("The gateway's token, if it requires one")] string token = "";
    [SerializeField, Tooltip("Unity's blendshapes range from 0 to 100")] float fullWeight = 100f;

    SkinnedMeshRenderer[] _meshes;
    KouxingStream _stream;
    string _connectionError = "";

    void OnEnable()
    {
        _meshes = GetComponentsInChildren<SkinnedMeshRenderer>().Where(mesh => mesh.sharedMesh).ToArray();
        _stream = new KouxingStream(gateway, session, _meshes.Select(mesh =>
            Enumerable.Range(0, mesh.sharedMesh.blendShapeCount).Select(mesh.sharedMesh.GetBlendShapeName)), token);
    }

    void OnDisable()
    {
        _stream?.Dispose();
        _stream = null;
    }

    void LateUpdate() // after the Animator
    {
        if (_stream == null) return;
        if (_stream.Error != "")
        {
            Debug.LogError($"kouxing: {_stream.Error}", this);
            enabled = false;
            return;
        }
        if (_stream.ConnectionError != _connectionError)
        {
            _connectionError = _stream.ConnectionError;
            if (_connectionError != "")
                Debug.LogWarning(
                    $"kouxing: cannot connect to the gateway at {gateway}; check the token: {_connectionError}", this);
        }
        int[][] targets = _stream.Targets;
        float[] weights = _stream.Weights;
        if (weights.Length != targets.Length) return;
        for (int i = 0; i < weights.Length; i++)
            _meshes[targets[i][0]].SetBlendShapeWeight(targets[i][1], fullWeight * weights[i]);
    }
}
